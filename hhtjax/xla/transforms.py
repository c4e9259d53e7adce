"""What of JAX's transformations is at work where a function runs."""

import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

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


def is_traced():
    """Whether what runs here becomes part of a program, or of a derivative or a batch, in less than a microsecond.

    Args:
        None.

    Returns:
        A boolean, known while a function is being traced; True where a JAX says it in words that are not known.

    Raises:
        Nothing.

    >>> import jax
    >>> seen = []
    >>> for change in (lambda f: f, jax.jit, jax.grad):
    ...     _ = change(lambda x: seen.append(is_traced()) or x)(1.0)
    >>> seen
    [False, True, True]
    """
    return type(_here.bind()).__name__ != KNOWN[0]


def batch_size(args, axes):
    """Number of the members of a batch. axes: of the arguments, None where all members share one."""
    return next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)


def in_front(x, axis, size):
    """An argument with the axis of the members in front, repeated where they share it."""
    return jnp.broadcast_to(x, (size, *jnp.shape(x))) if axis is None else jnp.moveaxis(x, axis, 0)


def is_in_batch():
    """Whether a batch is being made here, as far as a JAX says so: not of a jit of which one is made when it is traced.

    Args:
        None.

    Returns:
        A boolean, known while a function is being traced.

    Raises:
        Nothing.

    >>> import jax
    >>> seen, x = [], jax.numpy.ones(1)
    >>> for change in (jax.jit, jax.vmap, lambda f: jax.jit(jax.vmap(jax.grad(f)))):
    ...     _ = change(lambda x: seen.append(is_in_batch()) or x.sum())(x)
    >>> seen
    [False, True, True]
    """
    trace = _here.bind()
    while trace is not None and type(trace).__name__ != "BatchTrace":
        trace = getattr(trace, "parent_trace", None)
    return trace is not None


def forward_only(x, words):
    """The array x, of which a reverse derivative is refused in these words, and not in JAX's.

    Args:
        x: an array.
        words: of the error.

    Returns:
        The same array.

    Raises:
        TypeError: in reverse mode.

    >>> import jax
    >>> f = lambda x: forward_only(2 * x, "no reverse derivative")
    >>> float(jax.jvp(f, (1.0,), (1.0,))[1])
    2.0
    >>> try:
    ...     jax.grad(f)(1.0)
    ... except TypeError as error:
    ...     print(error)
    no reverse derivative
    """
    return forward_only_p.bind(x, words=words)


def _refuse(cotangent, x, words):
    raise TypeError(words)


forward_only_p = Primitive("hhtjax_forward_only")
forward_only_p.def_impl(lambda x, words: x)
forward_only_p.def_abstract_eval(lambda x, words: x)
ad.deflinear2(forward_only_p, _refuse)
batching.defvectorized(forward_only_p)
mlir.register_lowering(forward_only_p, lambda ctx, x, words: [x])


class _Here(Primitive):
    """What evaluates it; an older JAX hands over less beside that."""

    def bind_with_trace(self, trace, *_):
        return trace


_here = _Here("hhtjax_here")
