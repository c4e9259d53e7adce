"""What gradients are taken of, by which methods, and a reference to compare them with."""

import time
from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

from experiments.work_precision.cases import cases
from experiments.work_precision.timing import enough, seconds

STIFF = "hht, predictor", "hht, extrapolate=2", "rowda", "rodas5p"
SMOOTH = "hht, predictor", "hht, extrapolate=2", "rk4"
EXPLICIT = ("Tsit5", "forward"), ("Tsit5", "reverse")
IMPLICIT = ("Kvaerno3", "forward"), ("Kvaerno5", "forward")  # reverse takes longer, to compile and to run
PEERS = *EXPLICIT, *IMPLICIT, ("Kvaerno5", "reverse")
LONGEST_LINE = 10  # s behind its first point, after which nothing finer is tried


class Of(NamedTuple):
    """What is done on a scene. keys: of its parameters; forward: methods with constant steps; reverse: those of
    `simulate`; controlled: methods; peers: solvers of diffrax, and modes; seen: which positions are in the loss."""

    keys: tuple[str, ...] = ("k", "c")
    forward: tuple[str, ...] = STIFF
    reverse: tuple[str, ...] = ("hht",)
    controlled: tuple[str, ...] = ("rodas5p, adaptive",)
    peers: tuple = PEERS
    seen: tuple[int, ...] | None = None


EXPLICIT_ONES = "tsit5, adaptive", "taylor, adaptive"
SCENES = {
    "free double pendulum": Of(("m", "l"), SMOOTH, ("rk4",), EXPLICIT_ONES),
    "stiff double pendulum": Of(),
    "stiff double pendulum, torques as printed": Of(peers=(EXPLICIT[0], *IMPLICIT)),
    "stiff chain of 8": Of(
        forward=(*STIFF, "rk4"), reverse=(), controlled=EXPLICIT_ONES[:1], peers=(*EXPLICIT, *IMPLICIT)
    ),
    "forced Duffing": Of(("k", "c"), SMOOTH, ("hht", "rk4"), EXPLICIT_ONES),
    "hardening spring": Of(("k", "k3"), SMOOTH, ("rk4",), EXPLICIT_ONES, (*EXPLICIT, *IMPLICIT)),
    "squeezer": Of(("c0", "moment"), SMOOTH, (), EXPLICIT_ONES, EXPLICIT),
    # all entries of a rotation have a constant sum of squares: the vertical one of the rod alone
    "top": Of(("g", "a"), SMOOTH, ("rk4",), EXPLICIT_ONES, EXPLICIT, (7,)),
}


def scaled(name, s):
    """The parameters of a scene with each number of those in question times one of s."""
    params = cases()[name].scene.params
    values, unravel = ravel_pytree({key: params[key] for key in SCENES[name].keys})
    return {**params, **unravel(values * s)}


def start(name):
    """s of the parameters as they are."""
    params = cases()[name].scene.params
    return jnp.ones_like(ravel_pytree({key: params[key] for key in SCENES[name].keys})[0])


def seen(name, path):
    """Of positions (times, size) those that are in the loss."""
    return path[:, : cases()[name].size] if SCENES[name].seen is None else path[:, np.array(SCENES[name].seen)]


def nan_unless(fine):
    """A factor, so that derivatives are NaN too."""
    return jnp.where(fine, 1.0, jnp.nan)


@cache
def reference(name):
    """The gradient, by DOP853 at a tolerance of 1e-12 on the ODE with its sensitivities."""
    case = cases()[name]
    n, s = len(case.y0), start(name)

    @jax.jit
    def rate(t, Y):
        y, S = Y[:n], Y[n:].reshape(n, -1)

        def f(y, s):
            return case.rate(t, y, scaled(name, s))

        columns = [jax.jvp(f, (y, s), (S[:, i], jnp.zeros_like(s).at[i].set(1.0)))[1] for i in range(s.size)]
        return jnp.concatenate([f(y, s), jnp.stack(columns, axis=1).ravel()])

    Y0 = np.concatenate([case.y0, np.zeros(n * s.size)])
    span = 0.0, case.scene.duration
    run = solve_ivp(lambda t, Y: np.asarray(rate(t, Y)), span, Y0, "DOP853", case.times, rtol=1e-12, atol=1e-13)
    q = seen(name, run.y[:n].T)
    S = run.y[n:].reshape(n, s.size, -1)
    each = np.stack([seen(name, S[:, i].T) for i in range(s.size)], axis=-1)
    return 2 * np.mean(q[:, :, None] * each, axis=(0, 1))


def sweep(name, method, package, settings, gradient, always_compiles=False):
    """Rows: error and time of `gradient(setting)`, which is None where it failed."""
    rows, exact, begun = [], reference(name), None
    for i, setting in enumerate(settings):
        found, time_s = seconds(lambda setting=setting: gradient(setting), i == 0 or always_compiles)
        error = None
        if found is not None and np.all(np.isfinite(found)):
            error = float(np.linalg.norm(found - exact) / np.linalg.norm(exact))
        row = {"case": name, "method": method, "package": package, "setting": setting}
        rows.append(row | {"rms_error": error, "time_s": time_s})
        begun = begun or time.perf_counter()
        if enough(time_s, error) or time.perf_counter() - begun > LONGEST_LINE:
            break
    return rows
