"""EMPS, a measured positioning axis with dry friction: the benchmark's records, or generated ones, and its equation.

A. Janot, M. Gautier, M. Brunot, "Data Set and Reference Models of EMPS", Workshop on Nonlinear System Identification
Benchmarks, Eindhoven 2019. A motor moves a carriage by a ball screw, and a controller makes it follow a reference.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification.data import Record, columns, data_folder, downloaded, how_to_get

DT = 1e-3  # s, sampling period
GAIN = 35.1507  # N/V, force on the carriage over the voltage
HEAD = 20  # samples that may serve to find the initial state, and are not scored
HOLD = 0.5e-3  # s, by which an output that is held for a sample is late
KP, KV = 160.18, 243.45  # 1/s, V s/m: of the controller
PULSE = 5.07  # V, added for half of the test record, every other half second
STICTION_SPEED = 0.01  # m/s, over which friction falls from its value at rest
PARTS = "train", "test"
HOW_TO_GET_IT = how_to_get("DATA_EMPS.mat and DATA_EMPS_PULSES.mat of EMPS", "emps")
GENERATED = {"M": 95.0, "Fv": 200.0, "Fc": 20.0, "offset": -3.0, "Fa": -15.0}
OTHER_RUN = 1.04  # Fc of the generated test record over that of the training record
NOISE = 2e-6  # m, standard deviation


class Records(NamedTuple):
    """A training and a test record, u the voltage, V, y the position, m; hold: by how much u is late, s.

    measured: where they come from.
    """

    train: Record
    test: Record
    hold: float
    measured: bool


def load(fast: bool) -> Records:
    """The benchmark's records where they are found or can be downloaded, else generated ones; fast: a part of each."""
    files = found()
    end = 4000 if fast else None  # beyond the first reversal, without which Fc and the offset are one
    made = [Record(*read(file)) for file in files] if files else list(generate(end or 24841))
    train, test = (Record(record.u[:end], record.y[:end]) for record in made)
    return Records(train, test, HOLD if files else 0.0, bool(files))


def found():
    """Files of the training and of the test record: in the folder of data, or downloaded; none where there are none."""
    folder = data_folder() / "emps"
    for names in (("train.npz", "test.npz"), ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")):
        if all((folder / name).is_file() for name in names):
            return [folder / name for name in names]
    return [Path(file) for file in downloaded("EMPS")]


def read(file: Path):
    """Voltage and position."""
    if file.suffix != ".npz":
        return columns(str(file), "vir", "qm")
    with np.load(file) as content:
        if missing := [name for name in ("vir", "qm") if name not in content]:
            raise ValueError(f"{file} does not hold {', '.join(missing)}: {HOW_TO_GET_IT}.")
        return content["vir"], content["qm"]


def force(q, v, t, params):
    """Of the motor, less viscous friction, which may differ from one direction to the other, and a constant, N."""
    own, _ = params
    viscous = own.get("Fv", 0.0) * v + own.get("Fa", 0.0) * jnp.abs(v)
    return motor(t, params) - viscous - own["offset"]


def motor(t, params):
    """Its force on the carriage, N."""
    own, u = params
    return GAIN * u(t - own["delay"])


def limit(q, v, t, params):
    """Of the dry friction, N, with those of the further terms that params names."""
    own = params[0]
    F = own["Fc"] + 0 * v
    if "load" in own:
        F = F + own["load"] * jnp.abs(motor(t, params))
    if "Fs" in own:
        F = F + own["Fs"] * jnp.exp(-jnp.abs(v) / STICTION_SPEED)
    return F


def mass(q, params):
    return jnp.reshape(params[0]["M"], (1,))


SYSTEM = hhtjax.System(mass, force, friction=limit)


def reconstruct(u):
    """The input between its samples: straight lines. What a converter holds is that, late by half a sample."""
    return hhtjax.sampled(jnp.asarray(u), DT, order=1)


def simulate(own, u, q0, samples, substeps=1):
    """Position at `samples` samples from rest at q0 on, m: open loop, by the non-iterative step."""
    run = hhtjax.simulate(
        SYSTEM,
        hhtjax.hht(-0.05, linearize="predictor"),
        jnp.reshape(q0, (1,)),
        jnp.zeros(1),
        (own, u),
        dt=DT / substeps,
        num_steps=(samples - 1) * substeps,
        save_every=substeps,
    )
    return run.q[:, 0]


@jax.jit
def residuals(own, record: Record):
    """Simulated less measured position, mm."""
    return 1e3 * (simulate(own, reconstruct(record.u), record.y[0], len(record.y)) - record.y)


def score(own, record: Record):
    """Error of the position in mm at each sample, and its root mean square without the first samples."""
    error = np.asarray(residuals({name: jnp.asarray(x) for name, x in own.items()}, record))
    return error, float(np.sqrt(np.mean(error[HEAD:] ** 2)))


def controlled(q, v, t, params):
    """The same axis under its controller."""
    own, reference, pulses = params
    return force(q, v, t, (own, lambda _: command(q, v, t, reference, pulses)))


def command(q, v, t, reference, pulses):
    """The controller's voltage."""
    pulse = jnp.where(jnp.sin(2 * jnp.pi * t) > 0, PULSE * pulses, 0.0)
    return KP * KV * (reference(t) - q) - KV * v + pulse


def generate(samples):
    """Two records of the axis under its controller; the second one with pulses, and with more friction."""
    rng = np.random.default_rng(0)
    speed = np.repeat([0.13, 0, -0.13, 0, 0.06, 0, -0.06, 0, 0.1, 0, -0.1, 0], 1000)
    speed = np.convolve(np.resize(speed, samples), np.hanning(200) / np.hanning(200).sum(), mode="same")
    reference = hhtjax.sampled(jnp.asarray(DT * np.cumsum(speed)), DT)
    system = hhtjax.System(mass, controlled, friction=limit)
    for factor, pulses in ((1.0, 0.0), (OTHER_RUN, 1.0)):
        own = GENERATED | {"Fc": factor * GENERATED["Fc"], "delay": 0.0}
        params = {name: jnp.asarray(x) for name, x in own.items()}, reference, jnp.asarray(pulses)
        stepper = hhtjax.hht(-0.05, linearize="predictor")
        zero = jnp.zeros(1)
        run = hhtjax.simulate(system, stepper, zero, zero, params, dt=DT / 4, num_steps=4 * (samples - 1), save_every=4)
        u = command(run.q[:, 0], run.v[:, 0], run.t, reference, pulses)
        yield Record(np.asarray(u), np.asarray(run.q[:, 0]) + NOISE * rng.normal(size=samples))
