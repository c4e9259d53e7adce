"""Parameters from measurements: nonlinear least squares through the simulation.

    minimise  1/2 sum_i r_i(params)^2

with exact derivatives: Levenberg-Marquardt on forward-mode Jacobians for few parameters, any optax
optimiser on reverse-mode gradients for many.
"""

import sys
import warnings
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jax.flatten_util import ravel_pytree

from hhtjax.description import is_array, is_concrete
from hhtjax.steppers.stepper import require_number

RUNNING, COST, STEP, GRADIENT, LIMIT, STUCK, BAD_START = range(7)
REASONS = {
    RUNNING: "still running",
    COST: "converged: the cost changes by less than tolerance",
    STEP: "converged: the step is smaller than tolerance",
    GRADIENT: "converged: the gradient vanishes to within tolerance",
    LIMIT: "stopped: max_iterations reached",
    STUCK: "stopped: no step lowers the cost",
    BAD_START: "failed: the residual is not finite at params0",
}


class IdentifiabilityWarning(UserWarning):
    """The residuals do not determine every parameter."""


class History(NamedTuple):
    """Per iteration, the start first: cost, and the damping of Levenberg-Marquardt (None for optax)."""

    cost: Any
    damping: Any


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
    if not callable(residuals):
        raise TypeError(f"fit: `residuals` must be a function residuals(params); received {residuals!r}.")
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

    def f(x):
        r = residuals(unravel(scale * x))
        _check_residuals(r, p0.size)
        return ravel_pytree(r)[0]

    x0 = p0 / scale
    if optimizer is None:
        x, r, J, history, iterations, code = levenberg_marquardt(f, x0, tolerance, max_iterations, progress)
    else:
        x, history, iterations, code = descend(f, x0, optimizer, tolerance, max_iterations, progress)
        r, J = _with_jacobian(f, x) if covariance else (f(x), None)
    params = unravel(scale * x)
    C = errors = singular = None
    if J is not None and covariance:
        C, singular = _covariance(J / scale[None, :], r)
        errors = unravel(jnp.sqrt(jnp.diagonal(C)))
    shapes = residuals(params)
    result = FitResult(params, ravel_pytree(shapes)[1](r), jnp.sum(r**2) / 2, C, errors, history, iterations, code)
    return result, singular


def _with_jacobian(f, x):
    def twice(x):
        r = f(x)
        return r, r

    J, r = jax.jacfwd(twice, has_aux=True)(x)
    return r, J


class _Trial(NamedTuple):
    """A point, and the least-squares problem there, its columns scaled to one and reduced to p rows."""

    x: Any
    r: Any
    J: Any
    cost: Any
    column: Any  # norms of the columns of J
    s: Any  # singular values of J/column
    V: Any
    z: Any  # residual in the basis of the left singular vectors


def levenberg_marquardt(f, x, tolerance, max_iterations, progress):
    """Damped Gauss-Newton, dx = -(J^T J + lam D)^-1 J^T r with D the diagonal of J^T J.

    lam shrinks by 8 when a step lowers the cost and grows by 6 when it does not.
    """
    eps = float(jnp.finfo(x.dtype).eps)
    running = jnp.asarray(RUNNING, jnp.int32)

    def look(x):
        r, J = _with_jacobian(f, x)
        finite = jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(J))
        J_safe = jnp.where(finite, J, 0)
        norms = jnp.linalg.norm(J_safe, axis=0)
        column = jnp.where(norms == 0, 1, norms)
        Q, R = jnp.linalg.qr(J_safe / column[None, :])
        U, s, Vt = jnp.linalg.svd(R)
        cost = jnp.where(finite, jnp.sum(r**2) / 2, jnp.inf)
        return _Trial(x, r, J, cost, column, s, Vt.T, U.T @ (Q.T @ r))

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        now, lam, iteration, history, _ = carry
        weight = now.s / (now.s**2 + lam)
        step = -(now.V @ (weight * now.z)) / now.column
        predicted = jnp.sum(now.z**2 * (1 - (1 - now.s * weight) ** 2)) / 2
        new = look(now.x + step)
        lower = new.cost < now.cost
        lam = jnp.where(lower, lam / 8, lam * 6)
        iteration = iteration + 1
        honest = lower | (lam <= 1)  # a step is also small, and changes little, because lam is large
        flat = (predicted <= tolerance * now.cost) & (jnp.abs(now.cost - new.cost) <= tolerance * now.cost)
        short = jnp.all(jnp.abs(step) <= tolerance * (jnp.abs(now.x) + tolerance))
        best = jax.tree.map(partial(jnp.where, lower), new, now)
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(~lower & (lam > 1 / eps), STUCK, code)
        code = jnp.where(honest & short, STEP, code)
        code = jnp.where(honest & flat, COST, code)
        code = jnp.where(_gradient_cosine(best) <= tolerance, GRADIENT, code)
        history = History(history.cost.at[iteration].set(best.cost), history.damping.at[iteration].set(lam))
        if progress:
            _show(iteration, best.cost)
        return best, lam, iteration, history, code

    start = look(x)
    lam = jnp.asarray(1e-3, x.dtype)
    empty = jnp.full(max_iterations + 1, jnp.nan, x.dtype)
    history = History(empty.at[0].set(start.cost), empty.at[0].set(lam))
    code = jnp.where(_gradient_cosine(start) <= tolerance, GRADIENT, running)
    code = jnp.where(jnp.isfinite(start.cost), code, BAD_START)
    carry = start, lam, jnp.zeros((), jnp.int32), history, code
    best, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return best.x, best.r, best.J, history, iterations, code


def _gradient_cosine(trial):
    """Largest |cosine| of the angle between the residual and a column of the Jacobian."""
    length = jnp.sqrt(2 * trial.cost)
    return jnp.max(jnp.abs(trial.V @ (trial.s * trial.z))) / jnp.where(length == 0, 1, length)


def descend(f, x, optimizer, tolerance, max_iterations, progress, patience=5):
    """An optax optimiser on 1/2 sum f(x)^2; returns the best point it saw."""
    optimizer = optax.with_extra_args_support(optimizer)
    running = jnp.asarray(RUNNING, jnp.int32)

    def cost(x):
        return jnp.sum(f(x) ** 2) / 2

    def unfinished(carry):
        return carry[-1] == RUNNING

    def improve(carry):
        x, state, best, before, quiet, iteration, history, _ = carry
        value, gradient = jax.value_and_grad(cost)(x)
        best = jax.tree.map(partial(jnp.where, value < best[1]), (x, value), best)
        history = History(history.cost.at[iteration].set(value), None)
        quiet = jnp.where(jnp.abs(before - value) <= tolerance * value, quiet + 1, 0)
        code = jnp.where(iteration == max_iterations, LIMIT, running)
        code = jnp.where(quiet >= patience, COST, code)
        code = jnp.where(jnp.all(gradient == 0), GRADIENT, code)
        code = jnp.where(jnp.isfinite(value), code, jnp.where(iteration == 0, BAD_START, STUCK))
        if progress:
            _show(iteration, value)
        updates, state = optimizer.update(gradient, state, x, value=value, grad=gradient, value_fn=cost)
        x = jnp.where(code == RUNNING, x + jnp.asarray(updates), x)
        iteration = jnp.where(code == RUNNING, iteration + 1, iteration)
        return x, state, best, value, quiet, iteration, history, code

    infinity = jnp.asarray(jnp.inf, x.dtype)
    history = History(jnp.full(max_iterations + 1, jnp.nan, x.dtype), None)
    zero = jnp.zeros((), jnp.int32)
    carry = x, optimizer.init(x), (x, infinity), infinity, zero, zero, history, running
    _, _, (x, _), _, _, iterations, history, code = lax.while_loop(unfinished, improve, carry)
    return x, history, iterations, code


def _covariance(J, r):
    """s^2 (J^T J)^-1, and which parameters the residuals leave undetermined: infinite there."""
    m, p = J.shape
    norms = jnp.linalg.norm(J, axis=0)
    column = jnp.where(norms == 0, 1, norms)
    _, s, Vt = jnp.linalg.svd(jnp.linalg.qr(J / column[None, :], mode="r"))
    seen = s > 10 * m * float(jnp.finfo(J.dtype).eps) * s[0]
    undetermined = jnp.any(~seen[:, None] & (jnp.abs(Vt) > 1e-6), axis=0)
    if m == p:  # nothing left to estimate the variance from
        undetermined = jnp.ones(p, bool)
    inverse = jnp.where(seen, 1 / jnp.where(seen, s, 1) ** 2, 0)
    C = jnp.sum(r**2) / max(m - p, 1) * (Vt.T * inverse[None, :]) @ Vt / jnp.outer(column, column)
    both = undetermined[:, None] & undetermined[None, :]
    C = jnp.where(undetermined[:, None] | undetermined[None, :], 0, C)
    return jnp.where(both & jnp.eye(p, dtype=bool), jnp.inf, C), undetermined


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
    kinds = (jnp.floating, jnp.integer)
    if not (is_array(leaf) or isinstance(leaf, (int, float))) or isinstance(leaf, bool):
        raise TypeError(f"fit: {where} must be a real number or array; received {leaf!r}.")
    if not any(jnp.issubdtype(jnp.result_type(leaf), kind) for kind in kinds):
        raise TypeError(f"fit: {where} must be real; received {jnp.result_type(leaf)}.")
    if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
        raise ValueError(f"fit: {where} must be finite; received {leaf}.")


def _check_residuals(r, p):
    """Runs while tracing."""
    leaves = jax.tree.leaves(r)
    m = sum(jnp.size(x) for x in leaves)
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


def _show(iteration, cost):
    def show(iteration, cost):
        print(f"fit: iteration {int(iteration)}, cost {float(cost):.9g}", file=sys.stderr, flush=True)

    jax.debug.callback(show, iteration, cost)
