"""What of JAX's transformations is at work where a function runs."""

import jax
from jax.core import Tracer
from jax.interpreters import partial_eval

# of jit, which knows nothing of derivatives and batches that are made of it later; a JAX without it is slower
OF_JIT = getattr(partial_eval, "DynamicJaxprTracer", ())


def is_untouched(tree):
    """Whether no derivative and no batch is being made of these arrays; inside a jit it may be made of that later.

    Args:
        tree: a pytree of arrays.

    Returns:
        A boolean, known while a function is being traced.

    Raises:
        Nothing.

    >>> seen = []
    >>> for change in (lambda f: f, jax.jit, jax.grad, jax.vmap):
    ...     _ = change(lambda x: seen.append(is_untouched(x)) or x)(jax.numpy.ones(2)[0 if change is jax.grad else ...])
    >>> seen
    [True, True, False, False]
    """
    return not any(isinstance(x, Tracer) and not isinstance(x, OF_JIT) for x in jax.tree.leaves(tree))
