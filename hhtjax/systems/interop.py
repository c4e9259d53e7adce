"""Conversions for other packages: systems for diffrax and SciPy's `solve_ivp`, runs as tables; `hhtjax.interop`.

A second-order system becomes a first-order system of y = (q, v):

    q' = v,    v' = w with M(q) w = Q(q, v, t);    with constraints  [M -B^T; B 0] [w; L] = [Q; -(rest of d2Phi/dt2)]

Constraints are thus reduced to index 1: the errors of the solver add up, and Phi drifts away from 0. A rotation R has
R' = R hat(Om), and stays orthogonal to the accuracy of the solver. With internal states, y = (q, v, z).
"""

from __future__ import annotations

import csv
import importlib
from collections.abc import Callable
from functools import lru_cache, partial
from os import PathLike
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_number, require_params
from hhtjax.description import Array, Description, PyTree, Real, all_concrete, as_float, current, thaw
from hhtjax.description.presentation import shown
from hhtjax.systems.constraints import acceleration_and_multipliers
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.initial_conditions import initial_values, require_consistent
from hhtjax.systems.system import AnySystem, FirstOrderSystem, require_smooth, require_system

COLUMNS = (
    "t",
    "q",
    "v",
    "acceleration",
    "multipliers",
    "z",
    "zdot",
    "friction",
    "sticking",
    "contact",
    "error",
    "output",
)

__all__ = ["FlatODE", "ScipyRHS", "columns", "diffrax_term", "flat_ode", "ode", "scipy_rhs", "write_csv"]


def ode(system: AnySystem):
    """The system as an ODE on pytrees: a function (t, y, params) -> y' with y = (q, v).

    With internal states y = (q, v, z); for a `FirstOrderSystem` it is the y of y' = f(y, t). The function can be traced
    and differentiated. Equal systems give equal functions, also as pytrees.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`.

    Returns:
        (t, y, params) -> y', structured like y. A rotation matrix (3, 3) in y has its rate, also (3, 3), in y'.

    Raises:
        TypeError: `system` is not a system; when called, y is not (q, v), or (q, v, z).
        NotImplementedError: when called, dry friction or contact, whose forces are not functions of the state.

    >>> import jax.numpy as jnp, hhtjax
    >>> pendulum = hhtjax.System(jnp.ones(1), lambda q, v, t, params: {"angle": -params["g"] * jnp.sin(q["angle"])})
    >>> rate = hhtjax.interop.ode(pendulum)
    >>> rates = rate(0.0, ({"angle": jnp.pi / 2}, {"angle": 0.5}), {"g": 9.81})
    >>> [float(x["angle"]) for x in rates]
    [0.5, -9.81]
    """
    require_system("ode", system)
    return jax.tree_util.Partial(_ode, system)


@shown
class FlatODE(NamedTuple):
    """Result of `flat_ode`.

    Attributes:
        rate: (t, y, params) -> y' on vectors (N,); can be traced.
        y0: (N,), the start.
        unravel: y (N,) -> (q, v), or (q, v, z), pytrees; for a first-order system the pytree y.
    """

    rate: Any
    y0: Array
    unravel: Callable


def flat_ode(system: AnySystem, q0: PyTree, v0: PyTree = None, z0: PyTree = None) -> FlatODE:
    """The system as an ODE on vectors: y has the numbers of q, then v, then z, each in the order of `ravel_pytree`.

    Args:
        system, q0, v0, z0: as in `simulate`.

    Returns:
        A `FlatODE`.

    Raises:
        TypeError, ValueError: as `simulate`, for these arguments.
        NotImplementedError: when `rate` is called, dry friction or contact.

    >>> import jax.numpy as jnp, hhtjax
    >>> body = hhtjax.System(lambda R, params: params, lambda R, Om, t, params: -jnp.cross(Om, params * Om))
    >>> flat = hhtjax.interop.flat_ode(body, jnp.eye(3), jnp.array([0.0, 0.0, 2.0]))         # a rotation
    >>> flat.y0.shape, flat.rate(0.0, flat.y0, jnp.ones(3))[:9].reshape(3, 3)[0].tolist()
    ((12,), [0.0, -2.0, 0.0])
    """
    require_system("flat_ode", system)
    q0, v0, z0 = initial_values("flat_ode", system, q0, v0, z0)
    parts = [ravel_pytree(x) for x in (q0, v0, z0) if x is not None]
    rate = _FlatRate(system, tuple(x.size for x, _ in parts), tuple(unravel for _, unravel in parts))
    return FlatODE(rate, jnp.concatenate([x for x, _ in parts]), rate.unravel)


def diffrax_term(system: AnySystem):
    """The system as a `diffrax.ODETerm`, for `diffeqsolve(term, solver, t0, t1, dt0, y0=(q0, v0), args=params)`.

    y0 is (q0, v0), pytrees, or (q0, v0, z0), or the y0 of a `FirstOrderSystem`. args are the params, which may contain
    modules of equinox. diffrax then offers all that it has for ODEs: step-size control, events, adjoints. Held inputs,
    `sampled(order=0)`, jump. Pass the times of their jumps to `diffrax.ClipStepSizeController(..., jump_ts=)`.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`.

    Returns:
        A `diffrax.ODETerm`.

    Raises:
        TypeError: `system` is not a system.
        NotImplementedError: when called, dry friction or contact.
        ImportError: diffrax is not installed; it comes with the extra "interop".

    >>> import diffrax, jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -params["k"] * q)
    >>> found = diffrax.diffeqsolve(
    ...     hhtjax.interop.diffrax_term(spring), diffrax.Tsit5(), 0.0, 1.0, None, (jnp.ones(1), jnp.zeros(1)),
    ...     {"k": 4.0}, stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8))
    >>> q, v = found.ys
    >>> round(float(q[-1, 0]), 6)                                                                  # cos(2)
    -0.416147
    """
    require_system("diffrax_term", system)
    return _required("diffrax_term", "diffrax").ODETerm(ode(system))


@shown
class ScipyRHS(NamedTuple):
    """For `scipy.integrate.solve_ivp(fun, (t0, t1), y0, jac=jac)`; made by `scipy_rhs`.

    Attributes:
        fun: (t, y) -> y', (N,), compiled; takes and returns NumPy arrays.
        y0: (N,), the start.
        unravel: y -> the pytrees of `FlatODE.unravel`. y is (N,), or (N, times) as in SciPy's result; the pytrees then
            have a leading axis of times.
        jac: (t, y) -> the derivative of fun with respect to y, (N, N), compiled.
    """

    fun: Callable
    y0: np.ndarray
    unravel: Callable
    jac: Callable


def scipy_rhs(
    system: AnySystem,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    t0: Real = 0.0,
    z0: PyTree = None,
) -> ScipyRHS:
    """The right-hand side, start and Jacobian of a system for SciPy's `solve_ivp`, also for Radau, BDF and LSODA.

    Compiled once for each system and structure. New params or a new start cost no compilation. A call takes some
    microseconds, most of them for calling JAX and converting the result.

    Args:
        system, q0, v0, params, t0, z0: as in `simulate`, in double precision.

    Returns:
        A `ScipyRHS`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; initial values that violate a constraint; single
            precision.
        NotImplementedError: dry friction or contact.

    >>> import jax.numpy as jnp, hhtjax
    >>> from scipy.integrate import solve_ivp
    >>> stiff = hhtjax.System(jnp.ones(1), lambda q, v, t, params: {"x": -1e4 * params * v["x"] - q["x"]})
    >>> rhs = hhtjax.interop.scipy_rhs(stiff, {"x": 1.0}, {"x": 0.0}, 1.0)
    >>> run = solve_ivp(rhs.fun, (0.0, 1e3), rhs.y0, "Radau", jac=rhs.jac, rtol=1e-8, atol=1e-10)
    >>> q, v = rhs.unravel(run.y)
    >>> q["x"].shape == run.t.shape, round(float(q["x"][-1]), 6), run.nfev < 500                   # exp(-0.1)
    (True, 0.904837, True)
    """
    caller = "scipy_rhs"
    require_system(caller, system)
    params = require_params(caller, params)
    require_number(caller, "t0", t0, np.isfinite, "be finite")
    q0, v0, z0 = initial_values(caller, system, q0, v0, z0)
    if jax.tree.leaves(q0)[0].dtype != np.float64:
        raise ValueError(f"{caller}: SciPy computes in double precision: `q0` and `v0` must be float64 (with x64 on).")
    require_smooth(caller, system)
    flatten(caller, system, q0, v0, t0, thaw(params), z0)
    if system.constraint is not None:
        require_consistent(caller, system, q0, v0, t0, params, z0=z0)
    flat = flat_ode(system, q0, v0, z0)
    packed, unpack = _packed(params)
    functions = [f for f in vars(system).values() if callable(f)]
    state, programs = [], ()  # what the functions read, and the programs compiled for it

    def call(which, t, y):
        nonlocal state, programs
        now = list(map(current, functions))
        if not programs or now != state:
            state, programs = now, _compiled(flat.rate, jax.tree.structure(flat.rate), unpack)
        return np.asarray(programs[which](np.float64(t), y, packed))

    def unravel(y):
        return flat.unravel(jnp.asarray(y)) if np.ndim(y) == 1 else jax.vmap(flat.unravel)(jnp.asarray(y).T)

    return ScipyRHS(partial(call, 0), np.asarray(flat.y0), unravel, partial(call, 1))


def columns(solution: Any) -> dict[str, np.ndarray]:
    """A run as the columns of a table, one row for each saved time: `pandas.DataFrame(columns(solution))`.

    The name of a column is the attribute of the `Solution`, then keys of the pytree, then indices of the array: "t",
    "q[0]", "q.angle", "q.R[0,2]", "acceleration[1]", "multipliers[0]", "contact.normal[0]", "output.pull". Quantities
    that the run does not have get no column.

    Args:
        solution: the `Solution` of one run. Select member i of a batch by `jax.tree.map(lambda x: x[i], solution)`.

    Returns:
        A dict of NumPy arrays (K + 1,), with the dtype of the run.

    Raises:
        TypeError: `solution` is not a `Solution`, or contains tracers.
        ValueError: a batch of runs.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: {"x": -q["x"]})
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), {"x": jnp.ones(1)}, {"x": jnp.zeros(1)}, dt=0.5, num_steps=4)
    >>> table = hhtjax.interop.columns(run)
    >>> list(table), table["t"].tolist()
    (['t', 'q.x[0]', 'v.x[0]', 'acceleration.x[0]'], [0.0, 0.5, 1.0, 1.5, 2.0])
    """
    return _columns("columns", solution)


def write_csv(path: str | PathLike, solution: Any) -> None:
    """Writes a run as comma-separated values: the names of `columns` in the first line, then one line for each time.

    Numbers have as many digits as are needed to read the same number back: up to 17 for float64, up to 9 for float32.

    Args:
        path: path of the file, which is replaced if it exists.
        solution: as in `columns`.

    Returns:
        None.

    Raises:
        TypeError, ValueError: as `columns`.
        OSError: the file cannot be written.

    >>> import tempfile, jax.numpy as jnp, hhtjax
    >>> from pathlib import Path
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.5, num_steps=4)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     hhtjax.interop.write_csv(f"{folder}/run.csv", run)
    ...     print(*Path(folder, "run.csv").read_text().splitlines()[:2])
    t,q[0],v[0],acceleration[0] 0.0,1.0,0.0,-1.0
    """
    table = _columns("write_csv", solution)
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*(x.astype(str) for x in table.values()), strict=True))


def _columns(caller: str, solution: Any) -> dict[str, np.ndarray]:
    """The columns by name; raises an error that names the caller."""
    fields = getattr(solution, "_fields", ())
    if not {"t", "q", "output"} <= set(fields):
        raise TypeError(f"{caller}: `solution` must be a Solution; received {solution!r}.")
    given = {name: getattr(solution, name) for name in COLUMNS}
    if not all_concrete(given):
        raise TypeError(f"{caller}: `solution` must be known: call it outside jit, vmap and grad.")
    if np.ndim(solution.t) != 1:
        raise ValueError(
            f"{caller}: `solution` must be one run; received a batch of {np.shape(solution.t)[:-1]} runs. Take a "
            "member first: jax.tree.map(lambda x: x[i], solution)."
        )
    table = {}
    for name in COLUMNS:
        for path, x in jax.tree_util.tree_leaves_with_path(given[name]):
            where = jax.tree_util.keystr(path, simple=True, separator=".")
            x, title = np.asarray(x), f"{name}.{where}" if where else name
            for index in np.ndindex(x.shape[1:]):
                suffix = f"[{','.join(map(str, index))}]" if index else ""
                table[title + suffix] = x[:, *index]
    return table


def _ode(system, t, y, params: PyTree):
    """y' of a pytree y."""
    y = jax.tree.map(as_float, y)
    if isinstance(system, FirstOrderSystem):
        flat, q, v = flatten("ode", system, y, None, t, params)
        return flat.unravel(flat.force(q, v, jnp.asarray(t).astype(v.dtype), params))
    require_smooth("ode", system)
    internal = system.internal is not None
    if not isinstance(y, (tuple, list)) or len(y) != 2 + internal:
        expected = "(q, v, z), three pytrees" if internal else "(q, v), two pytrees"
        raise TypeError(f"ode: `y` must be {expected}; received {y!r}.")
    q, v, z = y if internal else (*y, None)
    flat, q, v = flatten("ode", system, q, v, t, params, z)
    at = q, v, jnp.asarray(t).astype(q.dtype), params
    w = acceleration_and_multipliers(flat, *at)[0] if flat.num_constraints else flat.acceleration(*at)
    rates = flat.unravel(flat.rate(q, v)), flat.unravel_rates(flat.located(w))
    return rates if flat.unravel_internal is None else (*rates, flat.unravel_internal(w[flat.positions :]))


class _FlatRate(Description):
    """`ode` on vectors; frozen and hashable, so that equal ones share a program."""

    def __init__(self, system: AnySystem, sizes: tuple, unravels: tuple):
        self.system, self.sizes, self.unravels = system, sizes, unravels

    def unravel(self, y):
        """(q, v), or (q, v, z), or y."""
        parts = jnp.split(y, np.cumsum(self.sizes)[:-1])
        found = [unravel(part) for unravel, part in zip(self.unravels, parts, strict=True)]
        return tuple(found) if len(found) > 1 else found[0]

    def __call__(self, t, y, params: PyTree):
        return ravel_pytree(_ode(self.system, t, self.unravel(y), params))[0]


def _packed(params: PyTree):
    """The params as one vector if all are float64, because a call with fewer arguments is faster; and the function that
    restores them."""
    leaves = jax.tree.leaves(params)
    if leaves and all(jnp.result_type(x) == np.float64 for x in leaves):
        vector, unpack = ravel_pytree(jax.tree.map(jnp.asarray, params))
        return np.asarray(vector), unpack
    return params, _same


def _same(x):
    return x


@lru_cache(maxsize=64)
def _compiled(rate, structure, unpack):
    """Right-hand side and Jacobian as compiled functions of (t, y, packed params). structure: the pytree structure of
    rate."""
    rate = jax.tree.unflatten(structure, jax.tree.leaves(rate))  # with what stands for its functions

    def program(t, y, packed):
        return rate(t, y, thaw(unpack(packed)))

    return jax.jit(program), jax.jit(jax.jacfwd(program, argnums=1))


def _required(caller: str, package):
    """Imports an optional package; the error says how to install it."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ImportError(f'{caller}: needs {package}: pip install "hhtjax[interop]".') from error
