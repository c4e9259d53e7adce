"""Two trials of a motion-tracked double pendulum: the measured ones where found, else generated ones.

M. Schmidt, H. Lipson, Science 324 (2009), supplementary data: angles from the downward vertical, about 100 Hz with
gaps.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification.data import data_folder

HOW_TO_GET_IT = (
    "download the supplementary data of Schmidt and Lipson (2009), put real_double_pend_h_1.txt into a folder "
    "double_pendulum/, and set the environment variable HHTJAX_DATA to the folder that holds double_pendulum/"
)
GENERATED = {"A": 0.28, "B": 0.26, "g1": 65.0, "g2": 17.0, "c1": 0.02, "c2": 0.01, "offset1": 0.01, "offset2": -0.02}
NOISE = 1.2e-3  # rad, standard deviation


class Trial(NamedTuple):
    """t: (samples,), s. angle, rate: (samples, 2), rad and rad/s; the rate is a guess, by differences."""

    t: Any
    angle: Any
    rate: Any


def load():
    """Training trial, test trial, and whether they were measured."""
    path = data_folder() / "double_pendulum" / "real_double_pend_h_1.txt"
    if not path.is_file():
        return _generate(0, (-1.1, -1.3), (0.0, -6.0)), _generate(1, (2.0, 2.5), (3.0, 9.0)), False
    table = np.genfromtxt(path, comments="%")
    trials = [table[table[:, 0] == k] for k in (0, 1)]
    train, test = (Trial(x[:, 1] - x[0, 1], x[:, 2:4], x[:, 4:6]) for x in trials)
    return train, test, True


def mass(q, params):
    """M = [[1, B cos(q1 - q2)], [., A]]: inertias over that of the first link."""
    coupling = params["B"] * jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([jnp.ones_like(coupling), coupling]), jnp.stack([coupling, params["A"]])])


def force(q, v, t, params):
    """Weight, centrifugal forces, and the friction of the two joints, of which some parts may be absent."""
    coupling = params["B"] * jnp.sin(q[0] - q[1])
    first = -params["g1"] * jnp.sin(q[0]) - coupling * v[1] ** 2
    second = -params["g2"] * jnp.sin(q[1]) + coupling * v[0] ** 2
    rates = v[0], v[1] - v[0]
    viscous, dry, quadratic = (params.get(name, (0.0, 0.0)) for name in ("viscous", "dry", "quadratic"))
    f1, f2 = (
        c * rate + d * jnp.tanh(rate / 0.1) + e * rate * jnp.abs(rate)
        for rate, c, d, e in zip(rates, viscous, dry, quadratic, strict=True)
    )
    return jnp.stack([first - f1 + f2, second - f2])


SYSTEM = hhtjax.System(mass, force)


def simulate(params, q0, v0, dt, num_steps):
    """A run by the non-iterative step."""
    stepper = hhtjax.hht(alpha=0.0, linearize="predictor")
    return hhtjax.simulate(SYSTEM, stepper, q0, v0, params, dt=dt, num_steps=num_steps)


def _generate(seed, q0, v0):
    """800 samples with gaps, from known parameters and steps four times finer than those of the fit."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(np.where(rng.random(800) < 0.02, 0.1, 0.01))
    t -= t[0]
    params: dict[str, Any] = {name: GENERATED[name] for name in ("A", "B", "g1", "g2")}
    params["viscous"] = GENERATED["c1"], GENERATED["c2"]
    run = simulate(params, jnp.array(q0), jnp.array(v0), 5e-4, int(np.ceil(t[-1] / 5e-4)))
    smooth = hhtjax.interpolate(run, t)
    angle = np.asarray(smooth.q) - [GENERATED["offset1"], GENERATED["offset2"]] + NOISE * rng.normal(size=(800, 2))
    return Trial(t, angle, np.asarray(smooth.v) + 0.05 * rng.normal(size=(800, 2)))
