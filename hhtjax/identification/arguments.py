"""Checks of the arguments of `fit`, which bring them into one form."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_function, require_integer
from hhtjax.description import Array, PyTree, Real, as_float, freeze, is_array, is_concrete, is_real
from hhtjax.identification import transforms as tf
from hhtjax.identification.losses import LOSSES

FEW = 64  # parameters up to which a forward-mode Jacobian is cheaper than a reverse-mode gradient
LEVENBERG_MARQUARDT = "levenberg_marquardt"


class Gaussian(NamedTuple):
    """A normally distributed prior of a parameter, for `fit(prior=...)`.

    Attributes:
        mean, deviation: mean and standard deviation, numbers, or arrays like the parameter.

    Raises:
        TypeError, ValueError: raised by `fit`: a mean or deviation that is not real; a deviation that is not positive.

    >>> import jax, hhtjax
    >>> result = hhtjax.fit(lambda p: p - jax.numpy.array([2.0, 4.0]), 0.0, prior=hhtjax.Gaussian(1.0, 0.5))
    >>> round(float(result.params), 6)                # (2 + 4 + 4 * 1)/(1 + 1 + 4): a prior like four samples
    1.666667
    """

    mean: Any
    deviation: Any


class Options(NamedTuple):
    """The static arguments of a fit, hashable."""

    optimizer: Any
    transforms: tuple
    loss: Any
    max_iterations: int
    covariance: bool
    segments: int
    progress: str  # whose fits to show, "fit" or "multistart"; "" for none


@cache
def for_many():
    """The optimiser of many parameters: one object, so that a second fit finds the first one's program."""
    import optax  # a quarter of the time to import hhtjax, and few fits need it

    return optax.lbfgs()


def is_of_optax(optimizer) -> bool:
    """Whether this is an optax optimiser. If optax is not imported, it cannot be one."""
    optax = sys.modules.get("optax")
    return optax is not None and isinstance(optimizer, optax.GradientTransformation)


def check_options(
    caller: str,
    params: PyTree,
    optimizer,
    transforms: PyTree,
    loss,
    max_iterations: int | None,
    covariance: bool,
    segments: int,
    progress: bool,
) -> Options:
    """`Options` with the defaults filled in; raises an error for a wrong argument."""
    if not (optimizer is None or optimizer == LEVENBERG_MARQUARDT or is_of_optax(optimizer)):
        raise TypeError(
            f'{caller}: `optimizer` must be an optax optimiser, "{LEVENBERG_MARQUARDT}" or None; '
            f"received {optimizer!r}."
        )
    transforms = check_transforms(caller, transforms, params)
    free = sum(np.size(p) for T, p in zip(transforms, jax.tree.leaves(params), strict=True) if T is not tf.fixed)
    if not free:
        raise ValueError(f"{caller}: `transforms` must leave a parameter free; received {tf.fixed} for all.")
    if optimizer is None:
        optimizer = LEVENBERG_MARQUARDT if free <= FEW else for_many()
    if callable(loss):
        require_function(caller, "loss", loss, "loss(z)")
    elif loss is not None and loss not in LOSSES:
        raise ValueError(f"{caller}: `loss` must be one of {', '.join(LOSSES)}, a function or None; received {loss!r}.")
    if max_iterations is None:
        max_iterations = 200 if optimizer == LEVENBERG_MARQUARDT else 1000
    max_iterations = require_integer(caller, "max_iterations", max_iterations)
    segments = require_integer(caller, "segments", segments, 2)
    rho = LOSSES.get(loss) if isinstance(loss, str) else loss
    return Options(optimizer, transforms, rho, max_iterations, covariance, segments, caller if progress else "")


def check_parameters(caller: str, params0: PyTree, name: str = "params0"):
    """params0 as a pytree of float arrays; functions in it become static."""
    given, params0 = params0, freeze(params0)
    leaves = jax.tree_util.tree_leaves_with_path(params0) or jax.tree_util.tree_leaves_with_path(given)
    for path, leaf in leaves:
        check_real(f"{caller}: `{name}{jax.tree_util.keystr(path)}`", leaf)
    if not sum(np.size(leaf) for _, leaf in leaves):
        raise ValueError(f"{caller}: `{name}` must hold at least one number; received {params0!r}.")
    return jax.tree.map(as_float, params0)


def check_scale(caller: str, scale, params0: PyTree):
    """The scale of each entry of params0, by default its size, or 1 where that is 0."""
    if scale is None:
        return jax.tree.map(_size, params0)
    scale = freeze(scale)
    if jax.tree.structure(scale) != jax.tree.structure(params0):
        raise ValueError(
            f"{caller}: `scale` must be a pytree structured like params0, {jax.tree.structure(params0)}; "
            f"received {jax.tree.structure(scale)}."
        )
    for (path, leaf), parameter in zip(
        jax.tree_util.tree_leaves_with_path(scale), jax.tree.leaves(params0), strict=True
    ):
        where = f"{caller}: `scale{jax.tree_util.keystr(path)}`"
        check_real(where, leaf)
        if is_concrete(leaf) and np.any(np.asarray(leaf) <= 0):
            raise ValueError(f"{where} must be positive; received {leaf}.")
        if jnp.shape(leaf) not in ((), parameter.shape):
            raise ValueError(
                f"{where} must have the shape of its parameter, {parameter.shape}; received {jnp.shape(leaf)}."
            )
    return jax.tree.map(lambda s, x: jnp.broadcast_to(jnp.asarray(s, x.dtype), x.shape), scale, params0)


def _size(x) -> Array:
    """|x|, and 1 where that is 0; by NumPy where it can, which has nothing to compile."""
    if not is_concrete(x):
        return jnp.where(x == 0, 1, jnp.abs(x))
    x = np.asarray(x)
    return jnp.asarray(np.where(x == 0, np.ones_like(x), np.abs(x)), x.dtype)


def check_prior(caller: str, prior: dict, params0: PyTree):
    """Mean and standard deviation of each leaf, pytrees like params0; inf where there is no prior."""

    def is_prior(x: PyTree) -> bool:
        return x is None or isinstance(x, Gaussian)

    def fill(entry: Gaussian | None, branch: Array) -> Gaussian:
        entry = Gaussian(0.0, np.inf) if entry is None else entry
        entry = Gaussian(*(jnp.asarray(y) if isinstance(y, (list, tuple)) else y for y in entry))
        check_real(f"{caller}: the mean in `prior`", entry.mean)
        if not is_real(entry.deviation):
            raise TypeError(f"{caller}: `prior` must have a real deviation; received {entry.deviation!r}.")
        if is_concrete(entry.deviation) and not np.all(np.asarray(entry.deviation) > 0):
            raise ValueError(f"{caller}: `prior` must have a positive deviation; received {entry.deviation}.")
        return jax.tree.map(lambda x: Gaussian(*(spread(y, x) for y in entry)), branch)

    def spread(y: Real, x: Array) -> Array:
        if jnp.shape(y) not in ((), x.shape):
            raise ValueError(
                f"{caller}: `prior` must have the shape of its parameter, {x.shape}; received {jnp.shape(y)}."
            )
        return jnp.broadcast_to(jnp.asarray(y, x.dtype), x.shape)

    require_entries(caller, "prior", prior, params0, "params0", is_prior, "Gaussian(mean, deviation)")
    return jax.tree.map(fill, prior, params0, is_leaf=is_prior)


def require_prefix(caller: str, name: str, prefix: PyTree, tree: PyTree, of: str, is_leaf: Callable | None = None):
    """Raises an error unless `prefix` has one entry for each leaf, or for whole branches, of `tree`. of: its name."""
    entries = prefix if is_leaf is None else jax.tree.map(lambda _: 0, prefix, is_leaf=is_leaf)  # None is one, too
    try:
        jax.tree.map(lambda *_: None, entries, tree)
    except ValueError as error:
        why = str(error).replace("tree_map tree", name)
        raise ValueError(f"{caller}: `{name}` must be a prefix of {of}: {why}") from None


def require_entries(caller: str, name: str, prefix: PyTree, tree: PyTree, of: str, is_entry: Callable, kinds: str):
    """`require_prefix`, after a check that every entry is of the right kind."""
    for path, entry in jax.tree_util.tree_leaves_with_path(prefix, is_leaf=is_entry):
        if not is_entry(entry):
            where = f"{name}{jax.tree_util.keystr(path)}"
            raise TypeError(f"{caller}: `{name}` must hold {kinds} or None; received {entry!r} as {where}.")
    require_prefix(caller, name, prefix, tree, of, is_entry)


def check_records(caller: str, records, starts, prior, optimizer: str):
    """The starts as float arrays; checks that starts and records have the same leading axis."""
    if records is None or starts is None:
        raise ValueError(
            f"{caller}: `records` and `starts` must be given together; received one of them. If records have no "
            "unknowns of their own, evaluate them all in residuals(params), by jax.vmap."
        )
    starts = check_parameters(caller, starts, "starts")
    require_leading_axis(caller, "`records` and `starts`", (records, starts))
    if optimizer != LEVENBERG_MARQUARDT or prior is not None:
        raise ValueError(f"{caller}: `records` must be used with Levenberg-Marquardt and without a prior.")
    return starts


def require_leading_axis(caller: str, names: str, tree: PyTree):
    """Raises an error unless all leaves have a leading axis of the same length. names: of the arguments."""
    counts = {jnp.shape(x)[:1] for x in jax.tree.leaves(tree)}
    if len(counts) != 1 or counts == {()}:
        raise ValueError(
            f"{caller}: {names} must have the same leading axis in all leaves; received the lengths {sorted(counts)}."
        )


def check_real(where: str, leaf: Real):
    """Raises an error unless `leaf` is a finite real number or array."""
    text = isinstance(leaf, np.ndarray) and leaf.dtype.kind not in "biufcV"  # V: the floats of 8 and 16 bits of JAX
    if not (is_array(leaf) or isinstance(leaf, (int, float))) or isinstance(leaf, bool) or text:
        raise TypeError(f"{where} must be a real number or array; received {leaf!r}.")
    if not is_real(leaf):
        raise TypeError(f"{where} must be real; received {jnp.result_type(leaf)}.")
    if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
        raise ValueError(f"{where} must be finite; received {leaf}.")


def check_transforms(caller: str, transforms: PyTree, params: PyTree, name: str = "params0"):
    """The transform of each leaf of params; checks that the transform can reach the values of the leaf."""
    transforms = _completed(caller, transforms, params, "", name)
    kinds = "hhtjax.positive, bounded(), fixed"
    require_entries(caller, "transforms", transforms, params, name, tf.is_transform, kinds)
    transforms = tf.per_leaf(transforms, params)
    for (path, leaf), T in zip(jax.tree_util.tree_leaves_with_path(params), transforms, strict=True):
        where = f"{caller}: `{name}{jax.tree_util.keystr(path)}`"
        of_one = jnp.shape(leaf)[1:] if name == "starts" else jnp.shape(leaf)
        if not T.fits(of_one):
            raise ValueError(f"{where} must have the shape of the bounds in `transforms`; received {of_one}.")
        if is_concrete(leaf) and not np.all(T.contains(leaf)):
            raise ValueError(f"{where} must {T.expectation}; received {leaf}.")
    return transforms


def _completed(caller: str, transforms: PyTree, params: PyTree, where: str, name: str):
    """Transforms with all keys of the dict `params`; missing keys become None."""
    if not (isinstance(transforms, dict) and isinstance(params, dict)):
        return transforms
    if unknown := [key for key in transforms if key not in params]:
        raise ValueError(
            f"{caller}: `transforms{where}` must have keys of {name}{where}, {', '.join(map(repr, params))}; "
            f"received {unknown[0]!r}."
        )
    pairs = ((key, _completed(caller, transforms.get(key), y, f"{where}[{key!r}]", name)) for key, y in params.items())
    return type(params)(pairs)
