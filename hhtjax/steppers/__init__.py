"""Time-stepping methods.

=================================  ====================  ================  ==========================================
stepper                            order                 solves per step   for
=================================  ====================  ================  ==========================================
`hht(alpha=-0.05)`                 2                     1                 stiff mechanics; the default. `linearize=`
                                                                           sets the point of linearisation
`hht(alpha, iterations=None)`      2                     Newton's          the converged method, differentiated
                                                                           implicitly
`newmark(beta, gamma)`             2; 1 for gamma > 1/2  1, or Newton's    the oldest of the family, same options
`bossak(alpha)`                    2                     1, or Newton's    same family, same options
`generalized_alpha(rho_inf)`       2                     1, or Newton's    same family, same options
`kim_hht(alpha)`                   1; 2 for alpha = 0    1                 Kim et al. (2019), as printed
`conventional_hht(alpha)`          1; 2 for alpha = 0    Newton's          a comparison in that paper
`kim_implicit_euler()`             1                     1                 a comparison in that paper
`rosenbrock(rho_inf=0)`            2                     2                 one factorisation; L-stable
`rowda()`                          3                     4                 one factorisation; L-stable; accurate
`rodas5p()`                        5                     8                 six digits or more, stiff, with a
                                                                           tolerance, `adaptive`
`extrapolated()`                   5                     15                six digits or more, stiff, with constraints
`houbolt()`                        2                     Newton's          a classical baseline
`park()`                           2                     Newton's          a classical baseline
`wilson(theta)`                    2                     Newton's          a classical baseline
`collocation(beta, theta)`         2                     Newton's          a classical baseline
`operator_splitting(alpha)`        2 for constant M and  1, no Jacobian    a baseline
                                   damping, else 1
`implicit_euler()`                 1                     Newton's          robustness
`rk4()`                            4                     explicit          motion that is not stiff
`dopri5()`, `tsit5()`              5                     explicit          not stiff, with a tolerance, `adaptive`
`dop853()`                         8                     explicit          not stiff, eight digits and more
`taylor(order)`                    any                   explicit          not stiff, faster, for functions that have
                                                                           Taylor series
=================================  ====================  ================  ==========================================

All of them also solve a first-order system, `FirstOrderSystem(rate)` with `rate(y, t, params)`; the solution's `q` is
y. Constraints and rotations: the `hht` family and `extrapolated`; also `conventional_hht`, in the form its authors
printed. Internal states: the `hht` family, `extrapolated`, Rosenbrock and Runge-Kutta methods and `taylor`. Dry
friction and contact: the `hht` family. Events: the `hht` family, Rosenbrock and Runge-Kutta methods and `taylor`. Error
control: the same without `rk4`, and `extrapolated`. `implicit_euler` supports the same features as the `hht` family,
except error control.

Some terms. A motion is stiff if it contains vibrations or decays much faster than those of interest, such as those of
stiff springs. A method is A-stable if no step size makes a decaying linear motion grow. It is L-stable if it also
removes infinitely fast decays at once. Its order is the power of h with which its error falls. Numerical damping is the
energy that a method removes from an undamped vibration; the spectral radius is the factor by which one step reduces the
amplitude. Non-iterative means that the nonlinear equations of an implicit step are solved by a single Newton step,
about a point of linearisation that is cheap and accurate enough. `python -m experiments linearization` measures which
point is best.

Which one
---------

Start with `hht()`. If the motion is smooth and nothing is stiff, `rk4()` is faster. With a tolerance use `taylor()`, or
`tsit5()` if a function has no Taylor series. For five digits or more of a stiff motion use `rodas5p()`; with
constraints or rotations use `extrapolated()` with a tolerance, or `simulate(..., extrapolate=2)`. For fitting by
gradients use `hht(linearize="predictor")`, which is smooth in everything that can be differentiated. If steps must be
far longer than the fastest vibration and the run blows up, try `hht(linearize="held")`, more damping (`alpha=-0.3`), or
`hht(iterations=None)`. The page `experiments/stability/README.md` shows where each method fails, and
`experiments/kim2019/README.md` repeats the tables and figures of the paper of 2019.

How long a step
---------------

`hhtjax.analysis.suggest_step_size` lists the modes of the linearised system and a step that resolves them. With
`duration=` it makes short runs until the motion itself is within the tolerance. To check a step, run a sweep over step
sizes:

>>> import jax.numpy as jnp, hhtjax
>>> oscillator = hhtjax.LinearSystem(M=jnp.ones(1), K=jnp.full(1, 100.0))
>>> start = jnp.ones(1), jnp.zeros(1)
>>> print(hhtjax.analysis.suggest_step_size(oscillator, hhtjax.hht(), *start, tolerance=1e-3).reason)
resolves the mode at 10 rad/s to 0.001
>>> runs = hhtjax.sweep(oscillator, hhtjax.hht(), *start, dts=jnp.array([0.02, 0.01, 0.005]), duration=1, num_samples=1)
>>> error = abs(runs.q[:, -1, 0] - jnp.cos(10.0))                        # a quarter for half the step: order 2
>>> [round(float(ratio), 1) for ratio in error[:-1] / error[1:]]
[3.8, 4.0]

A stepper of your own
---------------------

A method is a frozen dataclass derived from `Stepper`. It needs three members, which work on vectors q, v of a flat
system: its `order`; `begin`, which returns the `State` at the start; and `bind`, which does what is constant once and
returns the function State -> (State, Info) of one step. Everything else (pytrees, runs, sweeps, gradients, analysis,
fits) then works with it. First-order and internal states are rates without positions; they follow the other entries in
v and w, and `system.move` leaves them out. A method that supports them sets `solves_internal = True`.

>>> from dataclasses import dataclass
>>> from hhtjax import Info, State, Stepper
>>> @dataclass(frozen=True, eq=False)
... class SemiImplicitEuler(Stepper):
...     order: int = 1
...     def begin(self, system, q, v, t, params, dt):
...         return State(t, q, v, system.acceleration(q, v, t, params))
...     def bind(self, system, params, dt):
...         def step(s):
...             v = s.v + dt * s.w
...             q = system.move(s.q, dt * v)
...             return State(s.t + dt, q, v, system.acceleration(q, v, s.t + dt, params)), Info()
...         return step
>>> run = hhtjax.simulate(oscillator, SemiImplicitEuler(), *start, dt=1e-3, num_steps=1000)
>>> abs(float(run.q[-1, 0] - jnp.cos(10.0))) < 5e-3
True

A method whose state depends on the size of the last step also needs a method `resized`, as in `variable_step.py`.

An explicit Runge-Kutta method is defined by its coefficients, an `ExplicitTableau`, and a Rosenbrock method by a
`RosenbrockTableau`. With coefficients for an error estimate and for dense output, all runs and gradients work as with
the built-in methods.

>>> from hhtjax.steppers import ExplicitTableau, RungeKutta
>>> kutta = RungeKutta(ExplicitTableau("Kutta", A=((0.5,), (-1.0, 2.0)), b=(1 / 6, 2 / 3, 1 / 6)), order=3)
>>> run = hhtjax.simulate(oscillator, kutta, *start, dt=1e-3, num_steps=1000)
>>> abs(float(run.q[-1, 0] - jnp.cos(10.0))) < 1e-6
True

A method of the generalised-alpha kind only needs another set of coefficients, or another `advance`, as in
`implicit_euler`. Add a new method to `STEPPERS` in `tests/zoo.py`: its order, derivatives, dtypes, batches and error
messages are then tested on the problems there. Test its own features against a closed form.

For error control, `simulate(..., dt=adaptive(...))`, a method also needs an `estimate_order` k, a `begin_estimates`,
and a `bind_estimated`, whose step also returns the errors, of size h^k (`variable_step.py`).

Sources
-------

* N. Newmark, J. Eng. Mech. Div. ASCE 85 (1959) 67-94: `newmark`.
* H. Hilber, T. Hughes, R. Taylor, Earthquake Eng. Struct. Dyn. 5 (1977) 283-292: `hht`.
* M. Kim et al., J. Mech. Sci. Tech. 33 (2019) 1087-1096: the non-iterative step; `kim_hht`, `conventional_hht`.
* M. Arnold, O. Bruls, Multibody Syst. Dyn. 18 (2007) 185-202: second order with M(q) and constraints.
* K. Jansen, C. Whiting, G. Hulbert, Comput. Methods Appl. Mech. Eng. 190 (2000) 305-319: first-order systems,
  and internal states.
* W. Wood, M. Bossak, O. Zienkiewicz, Int. J. Numer. Methods Eng. 15 (1980) 1562-1566: `bossak`.
* J. Chung, G. Hulbert, J. Appl. Mech. 60 (1993) 371-375: `generalized_alpha`.
* A. Cardona, M. Geradin, Computers & Structures 33 (1989) 801-820: constraints and rotations.
* C. Gear, B. Leimkuhler, G. Gupta, J. Comput. Appl. Math. 12-13 (1985) 77-90: `formulation="ggl"`.
* O. Bruls, A. Cardona, J. Comput. Nonlinear Dyn. 5 (2010) 031002: `kinematics="lie"`.
* E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, Sec. IV.7: `rosenbrock`.
* G. Bader, P. Deuflhard, Numer. Math. 41 (1983) 373-398: `extrapolated`.
* G. Steinebach, BIT Numer. Math. 63 (2023) 27: `rodas5p`.
* C. Lubich, M. Roche, Computing 43 (1990) 325-342: `rowda`.
* J. Dormand, P. Prince, J. Comput. Appl. Math. 6 (1980) 19-26: `dopri5`.
* C. Tsitouras, Comput. Math. Appl. 62 (2011) 770-775: `tsit5`.
* E. Hairer, S. Norsett, G. Wanner, Solving Ordinary Differential Equations I, Sec. II.5: `dop853`.
* A. Jorba, M. Zou, Experimental Mathematics 14 (2005) 99-117: `taylor`.
* J. Houbolt, J. Aeronaut. Sci. 17 (1950) 540-550: `houbolt`. K. Park, J. Appl. Mech. 42 (1975) 464-470: `park`.
* E. Wilson, I. Farhoomand, K. Bathe, Earthquake Eng. Struct. Dyn. 1 (1973) 241-252: `wilson`.
* H. Hilber, T. Hughes, Earthquake Eng. Struct. Dyn. 6 (1978) 99-117: `collocation`.
"""

from hhtjax.steppers.rosenbrock import Rosenbrock as Rosenbrock
from hhtjax.steppers.runge_kutta import RungeKutta as RungeKutta
from hhtjax.steppers.tableaus import ExplicitTableau as ExplicitTableau
from hhtjax.steppers.tableaus import RosenbrockTableau as RosenbrockTableau
