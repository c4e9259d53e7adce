"""The generalised-alpha family, with and without iterations: the step, the method, and its constructors.

The formulas are in residual.py. Constraints, which add rows to the residual, are in constrained.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TYPE_CHECKING, Any, Unpack

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real, is_concrete
from hhtjax.numerics.dense_lu import factorize
from hhtjax.numerics.linear_solve import Structured, factorize_with
from hhtjax.numerics.sparse_lu import SparseLU
from hhtjax.numerics.structured_solve import Detected
from hhtjax.steppers.constrained import begin_constrained, bind_constrained
from hhtjax.steppers.contact import bind_contact
from hhtjax.steppers.contact_instant import begin_contact, jumped_contact
from hhtjax.steppers.friction import begin_friction, bind_friction, smoothed_friction
from hhtjax.steppers.implicit_solve import (
    factorized_once,
    factors_of,
    linear_part,
    linearized_solve,
    linearized_step,
    newton,
    refresh,
)
from hhtjax.steppers.options import Keywords, Options, check_options, require_alpha, takes_options
from hhtjax.steppers.residual import Coefficients, advance, coefficients, hht_coefficients, residual
from hhtjax.steppers.smooth_start import DEFAULT, at_start, grown, jumped, smoothed
from hhtjax.steppers.stepper import Info, State, Stepper, join_info
from hhtjax.steppers.variable_step import Controlled
from hhtjax.systems import kinematics
from hhtjax.systems.constraints import factorize_constrained
from hhtjax.systems.step_sparsity import detected

if TYPE_CHECKING:
    import numpy as np

    from hhtjax.systems.flat_system import FlatSystem


def step(
    method: GeneralizedAlpha, system: FlatSystem, params: PyTree, factorize: Any, where: str | None, dt: Real, s: State
) -> tuple[State, Info]:
    """One step from s to t + dt: by default one Newton step from the predictor, with one Jacobian and one solve.

    With `iterations` k it takes k Newton steps; with None it iterates until `tolerance`.
    """
    options, r = method.options, partial(residual, system, params)
    path = partial(method.arrive, system, s, dt)  # the state at t + dt, given its acceleration
    if options.iterations is None:
        w, info = newton(system, r, path, s.w, s, factorize, options.tolerance, options.max_iterations)
        return system.tidy(path(w)), info
    w, info = linearized_step(system, params, r, path, s, dt, factorize, where, method.estimating)
    for _ in range(options.iterations - 1):
        w, more = linearized_solve(r, path, w, factorize, again=method.estimating)
        info = join_info(info, more)
    s1 = path(w)
    if where == "state" and options.iterations == 1:
        s1, more = refresh(system, params, method.coefficients, s1, factorize)
        info = join_info(info, more)
    return system.tidy(s1), info


@dataclass(frozen=True, eq=False)
class GeneralizedAlpha(Controlled, Stepper):
    """A method of the family; made by `hht`, `newmark`, `bossak` and `generalized_alpha`."""

    coefficients: Coefficients
    order: int
    options: Options
    estimating: bool = False  # whether steps return their defect, for error control

    solves_constraints = True
    solves_rotations = True
    solves_internal = True
    solves_friction = True
    solves_contact = True
    meets_events = True
    keeps_sparse = True
    corrections = DEFAULT  # of the smooth start

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """The state at the start, w0 = a0 = M^-1 Q."""
        given = self.options.solve
        if system.matrices is not None and not (given is None or isinstance(given, Structured)):
            raise NotImplementedError(f"hht: leave out `solve` with sparse matrices; received {given!r}.")
        system = self.seen(system, params, q.dtype)
        if system.contact is not None:
            return begin_contact(self, system, q, v, t, params, dt)
        if system.friction is not None:
            return begin_friction(self, system, q, v, t, params, dt)
        if system.num_constraints:
            return begin_constrained(self, system, q, v, t, params)
        w = system.acceleration(q, v, t, params, self.factorize)
        return State(t, q, v, w, w)

    def smoothed(
        self,
        system: FlatSystem,
        state: State,
        params: PyTree,
        dt: Array,
        moves: bool = True,
        resolves: bool = False,
        alone: bool = False,
    ) -> State:
        """The state from which the first step starts, as `start` says."""
        if self.options.start == "simple" or not system.positions or (resolves and not self.corrects(system)):
            return state
        if system.contact is not None:
            return state
        smooth = smoothed if system.friction is None else smoothed_friction
        system = self.seen(system, params, state.q.dtype)
        return smooth(self, system, state, params, dt, moves, resolves, alone)

    def jumped(
        self, system: FlatSystem, before: State, after: State, old: PyTree, new: PyTree, dt: Array, answer: Callable
    ) -> State:
        """The state `after` a jump of held inputs; with a smooth start where damping is too stiff for dt."""
        if system.contact is not None:
            return jumped_contact(self, self.seen(system, new, before.q.dtype), before, new, dt)
        if self.options.start == "simple" or not system.positions:
            return after
        system = self.seen(system, new, before.q.dtype)

        def again(s, params: PyTree, dt: Array):
            start = begin_friction(self, system, s.q, s.v, s.t, params, dt)
            return smoothed_friction(self, system, start, params, dt)

        anew = None if system.friction is None else again
        return jumped(self, system, before, after, (old, new), dt, answer, anew)

    def grown(self, system: FlatSystem, state: State, params: PyTree, dt: Array) -> State:
        """The state, with a smooth start where damping is too stiff for dt."""
        smooth = smoothed if system.friction is None else smoothed_friction
        return grown(self, self.seen(system, params, state.q.dtype), state, params, dt, smooth)

    def throws(self, system: FlatSystem) -> bool:
        """True unless there are no positions, or `start` is "simple"."""
        return self.options.start != "simple" and system.positions > 0

    @property
    def starts_massless(self) -> bool:
        """Whether the start is a smooth one."""
        return self.options.start != "simple"

    def corrects(self, system: FlatSystem) -> bool:
        """Whether a0 is the second-order value."""
        start = self.options.start
        return self.resizes and (start == "corrected" or (start is None and system.num_constraints > 0))

    def corrected(self, system: FlatSystem, v: Array, w: Array, wdot: Array, dt: Array) -> Array:
        """a0 of second order: w0 + (alpha_m - alpha_f) h dw/dt; for charts with the second derivative of psi as w.

        Internal states may be far faster than h, so they keep their w0.
        """
        if self.options.kinematics == "chart" and system.blocks:
            wdot = system.with_internal(kinematics.chart_jerk(system.blocks, *map(system.located, (v, w, wdot))), wdot)
        return system.with_internal(w + (self.coefficients.alpha_m - self.coefficients.alpha_f) * dt * wdot, w)

    @property
    def factorize(self):
        """A -> (b, trans) -> A^-1 b: the library's LU, or the user's solve."""
        return factorize if self.options.solve is None else factorize_with(self.options.solve)

    def seen(self, system: FlatSystem, params: PyTree, dtype: np.dtype) -> FlatSystem:
        """The system with these params, and with the sparse solve that the options, or its elements, ask for."""
        system, given = system.settled(params), self.options.solve
        if isinstance(given, Detected):
            if system.friction is not None or system.contact or system.linear or self.redundant is not None:
                raise NotImplementedError(
                    "hht: leave out `solve` with dry friction, contact, a LinearSystem (whose matrices may be sparse) "
                    f"or redundant constraints; received {given!r}."
                )
            if system.sparse is not None and system.sparse.tolerance == given.tolerance and given.pattern is None:
                return system
            found = cache(lambda: detected(system, params, dtype, given.pattern))
            return system._replace(sparse=SparseLU(found, given.tolerance))
        if system.sparse is None:
            return system
        if given is not None or self.redundant is not None:
            return system.without_sparse_solve()
        if system.num_constraints or system.step_elements is None:
            return system
        return system._replace(sparse=replace(system.sparse, elements=system.step_elements(params)))

    @property
    def redundant(self):
        """How constraints that depend on each other are solved."""
        return self.options.redundant

    def factorize_for(self, system: FlatSystem):
        """As `factorize`, for constrained systems, whose rows may be redundant."""
        if system.sparse is not None:
            return system.sparse
        if isinstance(self.options.solve, Structured):
            raise NotImplementedError(f"hht: leave out `solve` with constraints; received {self.options.solve!r}.")
        if self.redundant is None and self.options.solve is not None:
            return self.factorize
        return factorize_constrained(system.size, self.redundant)

    def advance(self, s: State, dt: Array, w: Array):
        """Displacement, velocity, acceleration and algorithmic acceleration at t + dt."""
        return advance(self.coefficients, s, dt, w)

    def arrive(self, system: FlatSystem, s: State, dt: Array, w: Array, shift: Array | None = None):
        """State at t + dt, given its acceleration, the displacement changed by `shift`."""
        x, *rates = self.advance(s, dt, w)
        x = x if shift is None else x - shift
        if self.options.kinematics == "chart":
            rates = system.end_of_chart(x, *rates)
        return State(s.t + dt, system.move(s.q, x), *rates)

    def factorization(self, system: FlatSystem, params: PyTree, dt: Array):
        """The function that factorises the matrix of a step; for a linear system it is factorised here, once."""
        if system.num_constraints:
            return self.factorize_for(system)
        if system.linear and system.friction is None:
            return factorized_once(self, system, params, dt)
        return linear_part(self, system, params, dt) or system.sparse or self.factorize

    def factors_of(self, system: FlatSystem, dt: Array):
        """The `Factors` of a linear system with constant matrices, for callers that compute them once for many runs."""
        return factors_of(self, at_start(self), system, dt)

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """The step; for a linear system its matrix is factorised here, once."""
        system = self.seen(system, params, dt.dtype)
        if system.contact is not None:
            return bind_contact(self, system, params, dt)
        if system.friction is not None:
            return bind_friction(self, system, params, dt, linear_part(self, system, params, dt))
        if system.num_constraints:
            return bind_constrained(self, system, params, dt)
        where = "predictor" if system.linear else self.options.linearize  # linear: every point gives the same
        return partial(step, self, system, params, self.factorization(system, params, dt), where, dt)


@takes_options
def hht(alpha: Real = -0.05, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """HHT-alpha, by default non-iterative: one Jacobian, one factorisation, one solve per step.

        alpha_m = 0,  alpha_f = -alpha,  beta = (1 - alpha)^2/4,  gamma = 1/2 - alpha

    Order 2. A-stable on linear systems; spectral radius at infinite frequency (1 + alpha)/(1 - alpha).
    alpha = 0 is the trapezoidal rule, without damping and the least robust choice.

    Args:
        alpha: in [-1/3, 0]; a number, or a tracer to differentiate.
        iterations: 1: non-iterative; k: that many Newton iterations; None: Newton until `tolerance`.
        linearize: the point about which the first solve linearises M w - Q at t1.
            "predictor": q, v for constant acceleration. Smooth in all arguments. Use it for fitting, and for steps that
                resolve the motion. It is the first to fail at large steps: on stiffening springs, nonlinear dampers,
                chaotic links.
            "held": q + h v, with the v at t. Smooth. It stays bounded most often, but its error is 1.5 to 1.7 times as
                large on average.
            "state": (q, v, w) at t; the acceleration is then recomputed from M w1 = Q1 (Kim's step made second order).
                Best with nonlinear dampers. It loses two digits on the slow motion of stiff systems, fails at contacts,
                and needs a second factorisation, that of M.
            "auto": "predictor", or "held" where the predictor's residual is not negligible and the residual of "held"
                is smaller; such a step has a second solve. The result jumps by O(h^3) where the choice changes.
            Default: "auto" for one iteration, "predictor" for more. Over 14 scenes, 10 steps and 3 alphas, auto stayed
            bounded in 91 % of the runs, predictor in 85, held in 95, the converged method in 94. auto and predictor are
            equally accurate (`python -m experiments linearization`).
        tolerance: for the converged method (iterations=None only). Each row of the residual M w - Q must be below
            `tolerance`, in units of force, and below min(tolerance, 1e-6) times the size of the terms in that row. The
            iteration also ends when the residual is only rounding.
        max_iterations: Newton iterations before a step counts as failed (iterations=None only).
        start: how the recursion starts: at t0, after events, and where held inputs jump.
            "smooth": components of the velocity whose damping is too stiff for h first take an implicit step, and the
                acceleration is corrected with the matrix of the step. Motion that h resolves changes by O(h^5) only.
                Without this, a light, strongly damped coordinate that does not start with the velocity its forces
                demand is displaced by h^2 M^-1 Q (1/2 - beta/gamma), which can be any multiple of its correct
                displacement. `run.v[0]` is still the given v0.
            "corrected": as "smooth", and the algorithmic acceleration a starts from its second-order value,
                a0 = w0 + (alpha_m - alpha_f) h dw/dt. q, v and w have order 2 without it; a and multipliers need it.
            "simple": a0 = w0 = M^-1 Q, the unmodified recursion.
            Default: "smooth"; with constraints "corrected". Internal states keep their rates.
        formulation: how constraints are enforced. "ggl": enforces Phi = 0 and dPhi/dt = 0, with a second multiplier for
            each constraint (Gear, Gupta, Leimkuhler 1985). "index3": enforces Phi = 0 only, an equation of index 3;
            rounding errors of the multipliers, and of their derivatives, are amplified by 1/h^2. With constraints, as
            with dry friction, the residual is linearised once, at the predictor.
        redundant: "least_squares" for constraints that depend on each other, always or in singular positions. It
            returns the smallest multipliers, by one singular value decomposition per solve. By default dependent
            constraints are an error at the start, and later a failure that `solution.check()` reports for the step in
            which they become dependent. It is also needed for directions of dry friction that may become dependent, if
            neither their number nor the start shows it.
        kinematics: how rotations are integrated. "chart": the recursion runs on the rotation vector of each step
            (Cardona, Geradin 1989, made second order). "lie": it runs on the angular velocity (Bruls, Cardona 2010).
            This is simpler and of order 2 too, but has 4 to 5 times the error on a fast top.
        solve: `solve(A, b)` for A (n, n) and b (n,), instead of the library's LU. It need not be differentiable. For
            large systems use `banded(p)` or `conjugate_gradients(iterations)`. A relative residual above 1e-6 (1e-3 in
            float32; or the `tolerance` of these two) is a failure that `solution.check()` reports.

    Returns:
        A `Stepper`.

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
    return GeneralizedAlpha(hht_coefficients(alpha), 2, check_options("hht", **options))


@takes_options
def newmark(beta: Real = 0.25, gamma: Real = 0.5, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """Newmark(beta, gamma): alpha_m = alpha_f = 0. The default is the trapezoidal rule.

    Order 2 for gamma = 1/2, else 1 (and gamma > 1/2 damps). A-stable for 2 beta >= gamma >= 1/2.

    Args:
        beta: in (0, 1]; gamma: in [1/2, 1].
        **options: those of `hht`.

    Returns: a `Stepper`.
    Raises: TypeError, ValueError: an argument of the wrong kind, or out of its range.

    References:
        Newmark (1959); Cardona, Geradin (1989), Eq. 36.

    >>> import hhtjax
    >>> hhtjax.newmark().order, hhtjax.newmark(beta=0.3025, gamma=0.6).order
    (2, 1)
    """
    beta = require_number("newmark", "beta", beta, lambda x: 0 < x <= 1, "lie in (0, 1]")
    gamma = require_number("newmark", "gamma", gamma, lambda x: 0.5 <= x <= 1, "lie in [1/2, 1]")
    order = 2 if is_concrete(gamma) and gamma == 0.5 else 1
    return GeneralizedAlpha(Coefficients(0.0, 0.0, beta, gamma), order, check_options("newmark", **options))


@takes_options
def bossak(alpha: Real = -0.1, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """The method of Bossak (Wood, Bossak, Zienkiewicz): as HHT, but the inertia is averaged instead of the forces.

        alpha_m = alpha,  alpha_f = 0,  beta = (1 - alpha)^2/4,  gamma = 1/2 - alpha

    Order 2. A-stable. Spectral radius at infinite frequency (1 + alpha)/(1 - alpha).

    Args:
        alpha: in [-1, 0].
        **options: those of `hht`.

    Returns: a `Stepper`.
    Raises: TypeError, ValueError: an argument of the wrong kind, or out of its range.

    References:
        Wood, Bossak, Zienkiewicz (1980); Cardona, Geradin (1989), Sec. 2.

    >>> import hhtjax
    >>> hhtjax.bossak(alpha=-0.1).coefficients.alpha_m
    -0.1
    """
    alpha = require_number("bossak", "alpha", alpha, lambda x: -1 <= x <= 0, "lie in [-1, 0]")
    return GeneralizedAlpha(coefficients(alpha, 0.0), 2, check_options("bossak", **options))


@takes_options
def generalized_alpha(rho_inf: Real = 0.8, **options: Unpack[Keywords]) -> GeneralizedAlpha:
    """Chung and Hulbert's generalised-alpha: the least low-frequency damping for a given damping at infinite frequency.

        alpha_m = (2 rho - 1)/(rho + 1),  alpha_f = rho/(rho + 1),
        beta = (1 - alpha_m + alpha_f)^2/4,  gamma = 1/2 - alpha_m + alpha_f

    Order 2. A-stable.

    Args:
        rho_inf: rho, the spectral radius at infinite frequency, in [0, 1].
        **options: those of `hht`.

    Returns: a `Stepper`.
    Raises: TypeError, ValueError: an argument of the wrong kind, or out of its range.

    References:
        Chung, Hulbert (1993); Arnold, Bruls (2007).

    >>> import hhtjax
    >>> hhtjax.generalized_alpha(rho_inf=1.0).coefficients
    Coefficients(alpha_m=0.5, alpha_f=0.5, beta=0.25, gamma=0.5)
    """
    rho = require_number("generalized_alpha", "rho_inf", rho_inf, lambda x: 0 <= x <= 1, "lie in [0, 1]")
    weights = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    return GeneralizedAlpha(coefficients(*weights), 2, check_options("generalized_alpha", **options))


# ----------------------------------------------------------------------------
# Fully implicit Euler: the generalised-alpha method with another update.


@dataclass(frozen=True, eq=False)
class ImplicitEuler(GeneralizedAlpha):
    """Implicit Euler; made by `implicit_euler`."""

    def advance(self, s: State, dt: Array, w: Array):
        """v1 = v + h w1, x = h v1."""
        v = s.v + dt * w
        return dt * v, v, w, w


def implicit_euler(
    iterations: int | None = None, tolerance: Real = 1e-10, max_iterations: int = 20, solve: Callable | None = None
) -> ImplicitEuler:
    """Implicit Euler, v1 = v + h w1, q1 = q + h v1, M(q1) w1 = Q(q1, v1, t1), by Newton's iteration.

    Order 1, L-stable, strongly damping: a reference for robustness, not for accuracy. It supports constraints (GGL),
    rotations (in charts), internal states and dry friction, as `hht` does.

    Args:
        iterations: None: Newton until `tolerance`; k: that many Newton iterations.
        tolerance, max_iterations, solve: as in `hht`.

    Returns:
        A `Stepper`.

    Raises:
        TypeError, ValueError: an argument of the wrong kind, or out of its range.

    >>> import hhtjax
    >>> hhtjax.implicit_euler().order
    1
    """
    newton = {"iterations": iterations, "tolerance": tolerance, "max_iterations": max_iterations}
    options = check_options("implicit_euler", **newton, linearize="predictor", start="simple", solve=solve)
    return ImplicitEuler(Coefficients(0.0, 0.0, 1.0, 1.0), 1, options)
