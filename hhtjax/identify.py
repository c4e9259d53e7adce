"""Parameters from measurements: nonlinear least squares through the simulation.

    minimise  1/2 sum_i r_i(params)^2

with exact derivatives: Levenberg-Marquardt on forward-mode Jacobians for few parameters, any optax
optimiser on reverse-mode gradients for many.
"""

import warnings
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from hhtjax import least_squares
from hhtjax.boundary import require_function, require_number
from hhtjax.description import is_array, is_concrete, is_real
from hhtjax.least_squares import BAD_START, COST, GRADIENT, REASONS, STEP, History


class IdentifiabilityWarning(UserWarning):
    """The residuals do not determine every parameter."""


class FitResult(NamedTuple):
    """What `fit` returns.

    params: the estimate, structured like params0. residual: residuals(params). cost: 1/2 sum r^2.
    covariance: s^2 (J^T J)^-1 with s^2 = sum r^2/(m - p), (p, p); rows follow ravel_pytree(params); None
    if not asked for. standard_errors: root of its diagonal, structured like params. Both assume
    independent residuals of equal variance: where residuals are correlated, as after any model error, they
    are too small. A parameter that the residuals do not determine has variance inf, and covariances 0.
    history: `History`, NaN after the last iteration when made inside jit. iterations: how many.
    code: why it stopped, a key of `REASONS`.
    """

    params: Any
    residual: Any
    cost: Any
    covariance: Any
    standard_errors: Any
    history: History
    iterations: Any
    code: Any

    @property
    def converged(self):
        """Whether a tolerance was met."""
        return (self.code == COST) | (self.code == STEP) | (self.code == GRADIENT)

    @property
    def reason(self) -> str:
        """Why it stopped, in words."""
        return REASONS[int(self.code)]


def fit(
    residuals,
    params0,
    optimizer=None,
    *,
    scale=None,
    max_iterations=None,
    tolerance=1e-8,
    covariance=True,
    progress=False,
) -> FitResult:
    """The parameters that minimise the sum of squares of `residuals(params)`.

    Args:
        residuals: params -> any pytree of real arrays; traceable by JAX, so that its derivatives are exact.
        params0: where to start, any pytree of real numbers and arrays.
        optimizer: None, Levenberg-Marquardt with forward-mode Jacobians (a column for each parameter); or
            any optax optimiser, driven by reverse-mode gradients of the cost (optax.lbfgs() included).
        scale: typical size of each parameter: a pytree like params0, whose leaves are numbers or arrays of
            the shape of theirs. The optimiser works on params/scale. Default: |params0|, or 1 where that is 0.
            Levenberg-Marquardt scales itself, and uses it for its step tolerance only.
        max_iterations: default 50, or 1000 with an optimizer.
        tolerance: relative, on the change of the cost, on the scaled step and on the cosine between
            residual and Jacobian columns. With an optimizer: the relative change of the cost, five times running.
        covariance: False leaves out the covariance, one forward-mode Jacobian, with an optimizer.
        progress: print the cost after every iteration, to stderr.

    Returns:
        A `FitResult`. Inside jit or vmap, look at `result.code`; outside, trouble is raised or warned about.

    Raises:
        TypeError, ValueError: an argument of a wrong kind; residuals that are not finite at params0; more
            parameters than residuals.

    Warns:
        IdentifiabilityWarning: the Jacobian at the solution lacks rank: names the parameters concerned.

    References:
        Levenberg (1944); Marquardt (1963), with his scaling of the damping; Nocedal, Wright (2006), Ch. 10.

    >>> import jax.numpy as jnp, hhtjax
    >>> t = jnp.linspace(0.0, 1.0, 20)
    >>> measured = 3.0 * jnp.exp(-2.0 * t)
    >>> result = hhtjax.fit(lambda p: p["a"] * jnp.exp(-p["rate"] * t) - measured, {"a": 1.0, "rate": 1.0})
    >>> round(float(result.params["a"]), 3), round(float(result.params["rate"]), 3)
    (3.0, 2.0)
    """
    require_function("fit", "residuals", residuals, "residuals(params)")
    if optimizer is not None and not isinstance(optimizer, optax.GradientTransformation):
        raise TypeError(f"fit: `optimizer` must be an optax optimiser or None; received {optimizer!r}.")
    if max_iterations is None:
        max_iterations = 50 if optimizer is None else 1000
    if not isinstance(max_iterations, int) or max_iterations < 1:
        raise ValueError(f"fit: `max_iterations` must be a positive integer; received {max_iterations!r}.")
    require_number("fit", "tolerance", tolerance, lambda x: x > 0, "be positive")
    params0, scale = _parameters(params0, scale)
    result, singular = _fit(residuals, params0, scale, tolerance, optimizer, max_iterations, covariance, progress)
    if not is_concrete(result.code):
        return result
    if result.code == BAD_START:
        raise ValueError(f"fit: `residuals` must be finite at params0; received {_first_bad(result.residual)}.")
    if covariance:
        _warn_if_undetermined(result, singular)
    done = int(result.iterations) + 1
    return result._replace(history=jax.tree.map(lambda x: x[:done], result.history))


@partial(jax.jit, static_argnums=(0, 4, 5, 6, 7))
def _fit(residuals, params0, scale, tolerance, optimizer, max_iterations, covariance, progress):
    p0, unravel = ravel_pytree(params0)
    scale, _ = ravel_pytree(scale)
    tolerance = jnp.maximum(jnp.asarray(tolerance, p0.dtype), 10 * float(jnp.finfo(p0.dtype).eps))

    shapes = jax.eval_shape(residuals, params0)
    _check_residuals(shapes, p0.size)
    _, unravel_residual = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))

    def f(x):
        return ravel_pytree(residuals(unravel(scale * x)))[0]

    x0 = p0 / scale
    if optimizer is None:
        x, r, J, history, iterations, code = least_squares.levenberg_marquardt(
            f, x0, tolerance, max_iterations, progress
        )
    else:
        x, history, iterations, code = least_squares.descend(f, x0, optimizer, tolerance, max_iterations, progress)
        r, J = least_squares.with_jacobian(f, x) if covariance else (f(x), None)
    params = unravel(scale * x)
    C = errors = singular = None
    if J is not None and covariance:
        C, singular = least_squares.covariance(J / scale[None, :], r)
        errors = unravel(jnp.sqrt(jnp.diagonal(C)))
    result = FitResult(params, unravel_residual(r), jnp.sum(r**2) / 2, C, errors, history, iterations, code)
    return result, singular


def _parameters(params0, scale):
    """params0 and scale as pytrees of float arrays of the same shapes, checked."""
    leaves = jax.tree_util.tree_leaves_with_path(params0)
    if not leaves:
        raise ValueError(f"fit: `params0` must hold at least one number; received {params0!r}.")
    for path, leaf in leaves:
        _check_real(f"`params0{jax.tree_util.keystr(path)}`", leaf)

    def as_float(x):
        x = jnp.asarray(x)
        return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.result_type(float))

    params0 = jax.tree.map(as_float, params0)
    if scale is None:
        return params0, jax.tree.map(lambda x: jnp.where(x == 0, 1, jnp.abs(x)), params0)
    if jax.tree.structure(scale) != jax.tree.structure(params0):
        raise ValueError(
            f"fit: `scale` must be a pytree structured like params0, {jax.tree.structure(params0)}; "
            f"received {jax.tree.structure(scale)}."
        )
    for (path, leaf), parameter in zip(
        jax.tree_util.tree_leaves_with_path(scale), jax.tree.leaves(params0), strict=True
    ):
        where = f"`scale{jax.tree_util.keystr(path)}`"
        _check_real(where, leaf)
        if is_concrete(leaf) and np.any(np.asarray(leaf) <= 0):
            raise ValueError(f"fit: {where} must be positive; received {leaf}.")
        if jnp.shape(leaf) not in ((), parameter.shape):
            raise ValueError(
                f"fit: {where} must have the shape of its parameter, {parameter.shape}; received {jnp.shape(leaf)}."
            )
    return params0, jax.tree.map(lambda s, x: jnp.broadcast_to(jnp.asarray(s, x.dtype), x.shape), scale, params0)


def _check_real(where, leaf):
    if not (is_array(leaf) or isinstance(leaf, (int, float))) or isinstance(leaf, bool):
        raise TypeError(f"fit: {where} must be a real number or array; received {leaf!r}.")
    if not is_real(leaf):
        raise TypeError(f"fit: {where} must be real; received {jnp.result_type(leaf)}.")
    if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
        raise ValueError(f"fit: {where} must be finite; received {leaf}.")


def _check_residuals(r, p):
    """r: shapes and dtypes of the residuals; p: number of parameters."""
    leaves = jax.tree.leaves(r)
    m = sum(x.size for x in leaves)
    for leaf in leaves:
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise TypeError(f"fit: `residuals` must return real floats; received {jnp.result_type(leaf)}.")
    if m < p:
        raise ValueError(
            f"fit: `residuals` must return at least as many numbers as there are parameters, {p}; received {m}."
        )


def _first_bad(residual):
    """Words for the entries of a residual that are not finite."""
    values = [(path, np.asarray(leaf)) for path, leaf in jax.tree_util.tree_leaves_with_path(residual)]
    total = sum(x.size for _, x in values)
    bad = sum(int(np.sum(~np.isfinite(x))) for _, x in values)
    for path, x in values:
        if not np.all(np.isfinite(x)):
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(x))[0])
            return f"{x[index]} at residuals{jax.tree_util.keystr(path)}{list(index)} ({bad} of {total} entries)"
    return "a finite residual with a derivative that is not finite"


def _warn_if_undetermined(result, undetermined):
    if not np.any(undetermined):
        return
    if np.size(undetermined) == sum(np.size(x) for x in jax.tree.leaves(result.residual)):
        why = "there are as many residuals as parameters, so their variance cannot be estimated"
    else:
        why = "the Jacobian at the solution lacks rank, so a combination of these does not matter"
    names = []
    start = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path(result.params):
        flags = np.asarray(undetermined)[start : start + leaf.size].reshape(leaf.shape)
        start += leaf.size
        name = f"params{jax.tree_util.keystr(path)}"
        names += [f"{name}{list(map(int, i)) or ''}" for i in np.argwhere(flags)]
    warnings.warn(f"fit: no standard error for {', '.join(names)}: {why}.", IdentifiabilityWarning, stacklevel=3)
