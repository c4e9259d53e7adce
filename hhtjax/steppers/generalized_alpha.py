"""The generalised-alpha family: one residual, coefficients as data, with and without iterations.

State (q, v, w, a) with w the acceleration and a the algorithmic one (Arnold and Bruls 2007):

    q1 = q + h v + h^2 [(1/2 - beta) a + beta a1]
    v1 = v + h [(1 - gamma) a + gamma a1]
    (1 - alpha_m) a1 + alpha_m a = (1 - alpha_f) w1 + alpha_f w
    r(w1) = M(q1) w1 - Q(q1, v1, t1) = 0

Second order for every alpha, for M(q) and for explicit time. (The form printed in the literature,
M(q1) a1 = (1 + alpha) Q1 - alpha Q0, is first order once M depends on q and alpha is not 0.)

On rotations the first two lines give the rotation vector of the increment, from zero, and its rate: see kinematics.py.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.checks import require_function, require_number
from hhtjax.description import is_concrete
from hhtjax.numerics.linear_solve import Structured, diagonal, factorize, factorize_with, reuse
from hhtjax.steppers.constrained import begin_constrained, bind_constrained
from hhtjax.steppers.newton import left_by, linearized_solve, newton, told
from hhtjax.steppers.stepper import State, Stepper, join_info
from hhtjax.systems import kinematics
from hhtjax.systems.constraints import check_redundant, factorize_constrained
from hhtjax.xla import staged

LINEARIZATIONS = ("predictor", "held", "state", "auto")
HELD_THRESHOLD = 0.3  # "auto": residual, relative to M w, above which the held point may be preferred


class Coefficients(NamedTuple):
    """alpha_m, alpha_f, beta, gamma of the formulas above; numbers, or tracers to differentiate."""

    alpha_m: Any
    alpha_f: Any
    beta: Any
    gamma: Any


class Options(NamedTuple):
    """How the residual is solved; `hht` documents the fields."""

    iterations: int | None = 1
    linearize: str | None = None
    tolerance: float = 1e-10
    max_iterations: int = 20
    start: str | None = None
    formulation: str = "ggl"
    redundant: str | None = None
    kinematics: str = "chart"
    solve: Callable | None = None


class Keywords(TypedDict, total=False):
    """The same, as the keyword arguments of the constructors."""

    iterations: int | None
    linearize: str | None
    tolerance: float
    max_iterations: int
    start: str | None
    formulation: str
    redundant: str | None
    kinematics: str
    solve: Callable | None


def advance(c, s, dt, w):
    """Displacement from q, and the rest at t + dt, as an affine function of the new acceleration w."""
    a = ((1 - c.alpha_f) * w + c.alpha_f * s.w - c.alpha_m * s.a) / (1 - c.alpha_m)
    x = dt * s.v + dt**2 * ((0.5 - c.beta) * s.a + c.beta * a)
    v = s.v + dt * ((1 - c.gamma) * s.a + c.gamma * a)
    return x, v, w, a


def residual(system, params, s):
    """M(q) w - Q(q, v, t): zero on the trajectory."""
    return system.inertia(s.q, s.w, params) - system.force(s.q, s.v, s.t, params)


def linearization_point(system, params, s, predicted, where):
    """The state at t1 about which the non-iterative step expands r; None for the predictor itself."""
    if where == "predictor":
        return None
    if where == "state":
        return s._replace(t=predicted.t)
    held = s._replace(t=predicted.t, q=system.move(s.q, (predicted.t - s.t) * s.v))
    if where == "held":
        return held
    D = diagonal(system.mass(s.q, params))

    @staged
    def size(s):
        return jnp.sum(residual(system, params, s) ** 2 / D)

    predicted_size = size(predicted)
    use_predictor = lax.cond(
        predicted_size <= HELD_THRESHOLD**2 * jnp.sum(D * s.w**2),
        lambda: jnp.array(True),
        lambda: predicted_size <= size(held),
    )
    return jax.tree.map(partial(jnp.where, use_predictor), predicted, held)


@dataclass(frozen=True, eq=False)
class GeneralizedAlpha(Stepper):
    """A method of the family; made by `hht`, `newmark`, `bossak` and `generalized_alpha`."""

    coefficients: Coefficients
    order: int
    options: Options

    solves_constraints = True
    solves_rotations = True

    def begin(self, system, q, v, t, params, dt):
        """w0 = M^-1 Q, and a0 = w0 ("simple") or w0 + (alpha_m - alpha_f) h dw/dt ("corrected")."""
        c = self.coefficients
        if system.num_constraints:
            return begin_constrained(self, system, q, v, t, params, dt)

        def acceleration(q, v, t):
            return system.acceleration(q, v, t, params, self.factorize)

        shift = c.alpha_m - c.alpha_f
        if self.options.start != "corrected" or (is_concrete(shift) and shift == 0):
            w = acceleration(q, v, t)
            return State(t, q, v, w, w)
        w, tangent = jax.linearize(acceleration, q, v, t)
        return State(t, q, v, w, self.corrected(system, v, w, tangent(system.rate(q, v), w, jnp.ones_like(t)), dt))

    def corrected(self, system, v, w, wdot, dt):
        """a0 of second order: w0 + (alpha_m - alpha_f) h times the rate of psiddot, or of v."""
        if self.options.kinematics == "chart":
            wdot = kinematics.chart_jerk(system.blocks, v, w, wdot)
        return w + (self.coefficients.alpha_m - self.coefficients.alpha_f) * dt * wdot

    @property
    def factorize(self):
        """A -> (b, trans) -> A^-1 b: the library's LU, or the user's solve."""
        return factorize if self.options.solve is None else factorize_with(self.options.solve)

    @property
    def redundant(self):
        """How constraints that depend on each other are solved."""
        return self.options.redundant

    def factorize_for(self, system):
        """The same for constrained systems, whose rows may be redundant."""
        if isinstance(self.options.solve, Structured):
            raise NotImplementedError(f"hht: leave out `solve` with constraints; received {self.options.solve!r}.")
        return self.factorize if self.redundant is None else factorize_constrained(system.size, self.redundant)

    def advance(self, s, dt, w):
        """Displacement, velocity, acceleration and algorithmic acceleration at t + dt."""
        return advance(self.coefficients, s, dt, w)

    def arrive(self, system, s, dt, w, shift=None):
        """State at t + dt, given its acceleration, the displacement changed by `shift`."""
        x, *rates = self.advance(s, dt, w)
        x = x if shift is None else x - shift
        if self.options.kinematics == "chart":
            rates = kinematics.end_of_chart(system.blocks, x, *rates)
        return State(s.t + dt, system.move(s.q, x), *rates)

    def bind(self, system, params, dt):
        """The step; for a linear system its matrix is factorised here, once."""
        if system.num_constraints:
            return bind_constrained(self, system, params, dt)
        r = partial(residual, system, params)
        options, c = self.options, self.coefficients
        factorize, where = self.factorize, options.linearize
        if system.linear:
            where = "predictor"  # all points of linearisation are one
            zero = jnp.zeros(system.size, dt.dtype)
            rest = State(jnp.zeros_like(dt), zero, zero, zero, zero)
            inverse = self.factorize(jax.jacfwd(lambda w: r(self.arrive(system, rest, dt, w)))(zero))
            factorize = reuse(factorize, inverse)

        def step(s):
            path = partial(self.arrive, system, s, dt)
            if options.iterations is None:
                w, info = newton(system, r, path, s.w, s, factorize, options.tolerance, options.max_iterations)
                return system.tidy(path(w)), info
            at = linearization_point(system, params, s, path(s.w), where)
            w, info = linearized_solve(r, path, s.w, factorize, at)
            for _ in range(options.iterations - 1):
                w, more = linearized_solve(r, path, w, factorize)
                info = join_info(info, more)
            s1 = path(w)
            if where == "state" and options.iterations == 1:  # refresh: the acceleration of the new state
                Q = system.force(s1.q, s1.v, s1.t, params)
                w = system.acceleration(s1.q, s1.v, s1.t, params, factorize)
                left = left_by(factorize, lambda w: system.inertia(s1.q, w, params), Q, w)
                info = join_info(info, told(factorize, left))
                s1 = s1._replace(w=w, a=s1.a + (1 - c.alpha_f) / (1 - c.alpha_m) * (w - s1.w))
            return system.tidy(s1), info

        return step


def hht(alpha: Any = -0.05, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """HHT-alpha, by default non-iterative: one Jacobian, one factorisation, one solve per step.

        alpha_m = 0,  alpha_f = -alpha,  beta = (1 - alpha)^2/4,  gamma = 1/2 - alpha

    Order 2. A-stable on linear systems; spectral radius at infinite frequency (1 + alpha)/(1 - alpha).
    alpha = 0 is the trapezoidal rule, without damping and the least robust choice.

    Args:
        alpha: in [-1/3, 0]; a number, or a tracer to differentiate.
        iterations: 1, non-iterative; k, that many Newton iterations; None, Newton until `tolerance`.
        linearize: the point about which the first solve expands M w - Q at t1.
            "predictor": q, v for constant acceleration. Smooth in all arguments, so the one for fitting,
                and for steps that resolve the motion. Fails first at large steps: on stiffening springs,
                nonlinear dampers, chaotic links.
            "held": q + h v with v held. Smooth, the most bounded, 1.5 to 1.7 times the error on average.
            "state": (q, v, w) at t, the acceleration then refreshed by M w1 = Q1 (Kim's step made second
                order). Best with nonlinear dampers; loses two digits on a stiff slow manifold, fails at
                contacts, and costs a second factorisation, of M.
            "auto": predictor, or held where its residual is the smaller one and matters. One or two residuals more.
                The map jumps by O(h^3) where the choice changes.
            The default is "auto" for one iteration and "predictor" for more: over 14 scenes, 10 steps and 3
            alphas, auto stayed bounded in 91 % of the runs, predictor in 85, held in 95, the converged
            method in 94; auto and predictor are equally accurate (`python -m experiments linearization`).
        tolerance: on each row of the residual M w - Q, in units of force, and never more than a millionth of the
            row's own terms; a residual that is rounding ends the iteration too (iterations=None only).
        max_iterations: Newton iterations before a step counts as failed (iterations=None only).
        start: "simple", a0 = w0; "corrected", a0 = w0 + (alpha_m - alpha_f) h dw/dt, the second-order
            value. q, v and w are of order 2 with both; only a needs the correction, which blows up when
            h exceeds the fastest time scale of the system. Default: simple; corrected with constraints.
        formulation: of constraints. "ggl": Phi = 0 and dPhi/dt = 0, by one more multiplier for each (Gear,
            Gupta, Leimkuhler 1985); "index3": Phi = 0 alone. With constraints the one linearisation is at
            the predictor.
        redundant: "least_squares" for constraints that depend on each other, always or in singular positions: of
            their multipliers the smallest. One singular value decomposition per solve. By default they are
            an error at the start, and a failure named by `solution.check()` at the step where they become so.
        kinematics: of rotations. "chart": the recursion runs on the rotation vector of each step (Cardona, Geradin
            1989, made second order); "lie": on the angular velocity itself (Bruls, Cardona 2010). Simpler, of
            order 2 too, but 4 to 5 times the error on a fast top.
        solve: `solve(A, b)` for A (n, n) and b (n,), in place of the library's LU. Need not be differentiable. For
            large systems `banded(p)` or `conjugate_gradients(iterations)`. A residual above 1e-6 of b (1e-3 in
            float32; or the `tolerance` of these two) is a failure that `solution.check()` names.

    Raises:
        ValueError, TypeError: an argument out of its range or of the wrong kind.

    References:
        Hilber, Hughes, Taylor (1977); Kim et al. (2019), Eq. 1-2, 8-14; Arnold, Bruls (2007), Eq. 3.

    >>> import hhtjax
    >>> hhtjax.hht(alpha=-0.1).coefficients.gamma
    0.6
    >>> hhtjax.hht(alpha=0.2)
    Traceback (most recent call last):
    ValueError: hht: `alpha` must lie in [-1/3, 0]; received 0.2.
    """
    alpha = require_alpha("hht", alpha)
    return _member("hht", Coefficients(0.0, -alpha, (1 - alpha) ** 2 / 4, 0.5 - alpha), 2, options)


def newmark(beta: Any = 0.25, gamma: Any = 0.5, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """Newmark(beta, gamma): alpha_m = alpha_f = 0. The default is the trapezoidal rule.

    Order 2 for gamma = 1/2, else 1 (and gamma > 1/2 damps). A-stable for 2 beta >= gamma >= 1/2.

    Args:
        beta: in (0, 1]; gamma: in [1/2, 1].
        **options: those of `hht`.

    References:
        Newmark (1959); Cardona, Geradin (1989), Eq. 36.

    >>> import hhtjax
    >>> hhtjax.newmark().order, hhtjax.newmark(beta=0.3025, gamma=0.6).order
    (2, 1)
    """
    beta = require_number("newmark", "beta", beta, lambda x: 0 < x <= 1, "lie in (0, 1]")
    gamma = require_number("newmark", "gamma", gamma, lambda x: 0.5 <= x <= 1, "lie in [1/2, 1]")
    order = 2 if is_concrete(gamma) and gamma == 0.5 else 1
    return _member("newmark", Coefficients(0.0, 0.0, beta, gamma), order, options)


def bossak(alpha: Any = -0.1, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """Bossak (Wood, Bossak, Zienkiewicz): HHT's weighting put on the inertia instead of the forces.

        alpha_m = alpha,  alpha_f = 0,  beta = (1 - alpha)^2/4,  gamma = 1/2 - alpha

    Order 2. A-stable. Spectral radius at infinite frequency (1 + alpha)/(1 - alpha).

    Args:
        alpha: in [-1, 0].
        **options: those of `hht`.

    References:
        Wood, Bossak, Zienkiewicz (1980); Cardona, Geradin (1989), Sec. 2.

    >>> import hhtjax
    >>> hhtjax.bossak(alpha=-0.1).coefficients.alpha_m
    -0.1
    """
    alpha = require_number("bossak", "alpha", alpha, lambda x: -1 <= x <= 0, "lie in [-1, 0]")
    return _member("bossak", Coefficients(alpha, 0.0, (1 - alpha) ** 2 / 4, 0.5 - alpha), 2, options)


def generalized_alpha(rho_inf: Any = 0.8, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """Chung and Hulbert's generalised-alpha: least low-frequency damping for a given one at infinity.

        alpha_m = (2 rho - 1)/(rho + 1),  alpha_f = rho/(rho + 1),
        beta = (1 - alpha_m + alpha_f)^2/4,  gamma = 1/2 - alpha_m + alpha_f

    Order 2. A-stable.

    Args:
        rho_inf: rho, the spectral radius at infinite frequency, in [0, 1].
        **options: those of `hht`.

    References:
        Chung, Hulbert (1993); Arnold, Bruls (2007).

    >>> import hhtjax
    >>> hhtjax.generalized_alpha(rho_inf=1.0).coefficients
    Coefficients(alpha_m=0.5, alpha_f=0.5, beta=0.25, gamma=0.5)
    """
    rho = require_number("generalized_alpha", "rho_inf", rho_inf, lambda x: 0 <= x <= 1, "lie in [0, 1]")
    alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    shift = alpha_f - alpha_m
    return _member("generalized_alpha", Coefficients(alpha_m, alpha_f, (1 + shift) ** 2 / 4, 0.5 + shift), 2, options)


def require_alpha(caller, alpha):
    """HHT's alpha as it is, if it lies in its range."""
    return require_number(caller, "alpha", alpha, lambda x: -1 / 3 - 1e-12 <= x <= 0, "lie in [-1/3, 0]")


def _member(caller, coefficients, order, keywords):
    for name in keywords:
        if name not in Options._fields:
            raise TypeError(f"{caller}: unknown option {name!r}; the options are {', '.join(Options._fields)}.")
    return GeneralizedAlpha(coefficients, order, check_options(caller, Options(**keywords)))


def check_options(caller, options):
    """The options with the default of `linearize` filled in, or an error that names what is wrong."""
    iterations, linearize, tolerance, max_iterations, start, formulation, redundant, kinematics, solve = options
    if iterations is not None and (not isinstance(iterations, int) or isinstance(iterations, bool) or iterations < 1):
        raise ValueError(f"{caller}: `iterations` must be a positive integer or None; received {iterations!r}.")
    if linearize is None:
        linearize = "auto" if iterations == 1 else "predictor"
    if linearize not in LINEARIZATIONS:
        raise ValueError(f"{caller}: `linearize` must be one of {', '.join(LINEARIZATIONS)}; received {linearize!r}.")
    if iterations is None and linearize != "predictor":
        raise ValueError(
            f"{caller}: with iterations=None, Newton starts from the predictor: leave `linearize` out; "
            f"received {linearize!r}."
        )
    require_number(caller, "tolerance", tolerance, lambda x: x > 0, "be positive")
    if not isinstance(max_iterations, int) or isinstance(max_iterations, bool) or max_iterations < 1:
        raise ValueError(f"{caller}: `max_iterations` must be a positive integer; received {max_iterations!r}.")
    if start not in (None, "corrected", "simple"):
        raise ValueError(f'{caller}: `start` must be "corrected" or "simple"; received {start!r}.')
    if formulation not in ("ggl", "index3"):
        raise ValueError(f'{caller}: `formulation` must be "ggl" or "index3"; received {formulation!r}.')
    check_redundant(caller, redundant)
    if redundant is not None and solve is not None:
        raise ValueError(f"{caller}: `redundant` brings its own solver: leave out `solve`, or `redundant`.")
    if kinematics not in ("chart", "lie"):
        raise ValueError(f'{caller}: `kinematics` must be "chart" or "lie"; received {kinematics!r}.')
    if solve is not None:
        require_function(caller, "solve", solve, "solve(A, b)")
    return options._replace(linearize=linearize)
