"""What of JAX's transformations is at work where a function runs."""

from jax.extend.core import Primitive

KNOWN = "EvalTrace", "DynamicJaxprTrace"  # without any, and inside a jit


def is_untouched():
    """Whether neither a derivative nor a batch is being made here; of a jit one may be made when it has been traced.

    Args:
        None.

    Returns:
        A boolean, known while a function is being traced; False where a JAX says it in words that are not known.

    Raises:
        Nothing.

    >>> import jax
    >>> seen, x = [], jax.numpy.ones(())
    >>> for change in (lambda f: f, jax.jit, jax.grad, lambda f: jax.jit(jax.grad(f)), lambda f: jax.grad(jax.jit(f))):
    ...     _ = change(lambda x: seen.append(is_untouched()) or x)(x)
    >>> seen
    [True, True, False, False, True]
    """
    return type(_here.bind()).__name__ in KNOWN


class _Here(Primitive):
    """What evaluates it; an older JAX hands over less beside that."""

    def bind_with_trace(self, trace, *_):
        return trace


_here = _Here("hhtjax_here")
