"""Cascaded tanks: the measured records of the benchmark, or generated ones of the same shape, and the model's terms.

M. Schoukens, P. Mattsson, T. Wigren, J.-P. Noel, "Cascaded tanks benchmark combining soft and hard nonlinearities",
Workshop on Nonlinear System Identification Benchmarks, Brussels 2016. A pump fills the upper tank, which drains into
the lower one, whose level is read. Both overflow, the upper one in part into the lower.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification.data import Record, columns, data_folder, downloaded, how_to_get

DT = 4.0  # s, sampling period
SAMPLES = 1024
INITIAL = 4  # samples that the benchmark gives for the initial state
RIM = 10.0  # V, of the upper tank: this fixes the unit of its level, which is not measured
FULL = 10.0  # V, where the sensor saturates
RELEASE = 5.5  # V, where a reading that had been higher falls, twice in the training record
WEIR = 1.0  # 1/s, of water above a rim: fast beside DT, so that its value does not matter
NOISE = 0.02  # V, standard deviation
STORED = {"u_train": "uEst", "u_test": "uVal", "y_train": "yEst", "y_test": "yVal"}  # and the benchmark's own names
HOW_TO_GET_IT = how_to_get("dataBenchmark.csv of the cascaded tanks (as tanks.csv)", "cascaded_tanks")
GENERATED = {"k1": 0.037, "k2": 0.054, "k3": 0.087, "k4": 0.028, "u0": -1.0, "x1": 7.5, "x2": 5.2}
GENERATED |= {"over": 1.2, "rim": 10.2, "caught": 0.06}


class Records(NamedTuple):
    """A training and a test record: u the pump's voltage, held over each period, y the lower level's reading, in V.

    measured: where they come from.
    """

    train: Record
    test: Record
    measured: bool


def load(fast: bool) -> Records:
    """The benchmark's records where they are found or can be downloaded, else generated ones; fast: a part of each."""
    measured = found()
    data = measured or generate()
    end = 400 if fast else None
    train, test = (Record(data[f"u_{part}"][:end], data[f"y_{part}"][:end]) for part in ("train", "test"))
    return Records(train, test, measured is not None)


def found():
    """Its columns by name: of the folder of data, or downloaded; None where there are none."""
    path = data_folder() / "cascaded_tanks" / "tanks.csv"
    if path.is_file():
        return read(path)
    for file in downloaded("Cascaded_Tanks"):
        if file.endswith(".mat"):
            return dict(zip(STORED, columns(file, *STORED.values()), strict=True))
    return None


def read(path: Path):
    """The columns of the file, by name."""
    header, *lines = path.read_text().splitlines()
    names = [name.strip(' "') for name in header.split(",")]
    wanted = [own if own in names else original for own, original in STORED.items()]
    if missing := [name for name in wanted if name not in names]:
        raise ValueError(f"{path} has no columns {', '.join(missing)}: {HOW_TO_GET_IT}.")
    table = np.array([[float(line.split(",")[names.index(name)]) for name in wanted] for line in lines if line.strip()])
    if table.shape != (SAMPLES, len(STORED)) or not np.all(np.isfinite(table)):
        raise ValueError(
            f"{path} must hold {SAMPLES} rows of finite numbers; received shape {table.shape}: {HOW_TO_GET_IT}."
        )
    return dict(zip(STORED, table.T, strict=True))


def generate():
    """The same from the equations: slow noise through pump and tanks that overflow now and then."""
    rng = np.random.default_rng(3)
    made = {}
    for part in ("train", "test"):
        spectrum = np.fft.rfft(rng.normal(size=SAMPLES))
        spectrum[np.fft.rfftfreq(SAMPLES, DT) > 0.005] = 0  # Hz
        u = np.fft.irfft(spectrum, SAMPLES)
        made[f"u_{part}"] = np.maximum(2.8 + 1.1 * u / u.std(), 0.4)
        y = np.asarray(simulate(GENERATED, made[f"u_{part}"], substeps=8))
        made[f"y_{part}"] = np.minimum(y + NOISE * rng.normal(size=SAMPLES), FULL)
    return made


def positive(x, width):
    """max(x, 0), smoothed over `width`: (x + sqrt(x^2 + width^2))/2."""
    return (x + jnp.sqrt(x**2 + width**2)) / 2


def rate(x, t, params):
    """Rates of both levels in V/s, with those of the further terms that params names.

    x1' = k4 (u - u0) - k1 sqrt(x1) - over1
    x2' = k2 (1 + caught x2) sqrt(x1) + over over1 - k3 sqrt(x2) - linear x2 - over2
    over1 = WEIR max(x1 - RIM, 0),    over2 = WEIR max(x2 - rim, 0)
    """
    own, u = params
    upper, lower = (jnp.sqrt(positive(level, 0.01)) for level in x)
    over = WEIR * positive(x[0] - RIM, 0.1)
    into = own["k2"] * (1 + own.get("caught", 0.0) * x[1]) * upper + own.get("over", 0.0) * over
    out = own.get("k3", 0.0) * lower + own.get("linear", 0.0) * x[1]
    if "rim" in own:
        out = out + WEIR * positive(x[1] - own["rim"], 0.1)
    return jnp.stack([own["k4"] * (u(t) - own["u0"]) - own["k1"] * upper - over, into - out])


SYSTEM = hhtjax.FirstOrderSystem(rate)


def reading(own, levels):
    """The sensor's output in V, from levels at the samples, (samples, 2).

    It saturates; with `pressure` the jet from the upper tank, which lands near the sensor, lowers it; and with `jump` a
    reading that rose past `stick` is too high by so much until it falls below RELEASE.
    """
    y = levels[:, 1]
    if "pressure" in own:
        y = y - own["pressure"] * (jnp.sqrt(positive(levels[:, 0], 0.01)) - np.sqrt(RIM / 2))
    if "jump" in own:

        def stuck(z, y):
            z = jnp.maximum(z, jax.nn.sigmoid((y - own["stick"]) / 0.12))
            z = z * jax.nn.sigmoid((y + own["jump"] * z - RELEASE) / 0.03)
            return z, z

        y = y + own["jump"] * jax.lax.scan(stuck, jnp.zeros_like(y[0]), y)[1]
    return FULL - positive(FULL - y, 0.05)


def simulate(own, u, substeps: int = 2, alpha: Any = -0.05, start=None):
    """The reading at each sample of u, by the non-iterative step; start: of the lower level, else that of `own`."""
    held = hhtjax.sampled(u, DT, order=0)
    run = hhtjax.simulate(
        SYSTEM,
        hhtjax.hht(alpha, linearize="predictor"),  # smooth in the parameters
        jnp.stack([jnp.asarray(own["x1"]), jnp.asarray(own["x2"] if start is None else start)]),
        params=(own, held),
        dt=DT / substeps,
        num_steps=(len(u) - 1) * substeps,
        save_every=substeps,
    )
    return reading(own, run.q)
