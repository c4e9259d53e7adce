"""Bouc-Wen hysteresis: the records of the benchmark, or generated ones of the same shape.

J.-P. Noel, M. Schoukens, "Hysteretic benchmark with a dynamic nonlinearity", Workshop on Nonlinear System
Identification Benchmarks, Brussels 2016. The system is simulated, and its test records are free of noise. There is no
official training record: the one used here was made by others with the integrator of the benchmark, with noise of
8e-6 m rms.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.identification.data import columns, data_folder, downloaded
from hhtjax.scenes import bouc_wen

SAMPLING_RATE = 750.0  # Hz
DT = 1 / SAMPLING_RATE
PERIOD = 8192  # samples of a multisine
FINEST = 20  # steps in a sample: the rate of the benchmark's own integrator
NOISE = 8e-6  # m, standard deviation
STORED = ("train_u", "train_y", "multisine_u", "multisine_y", "sinesweep_u", "sinesweep_y")
HOW_TO_GET_IT = (
    "install what downloads it, `pip install -e '.[data]'`; or make bouc_wen/bouc_wen.npz from the data of the "
    f"Bouc-Wen benchmark of nonlinearbenchmark.org, with the arrays {', '.join(STORED)} in N and m at 750 Hz, and set "
    "the environment variable HHTJAX_DATA to the folder that holds bouc_wen/"
)


class Record(NamedTuple):
    """Uniform samples of the force u, N, and of the displacement y, m; period: samples of a period of u, or None."""

    u: Any
    y: Any
    period: int | None


class Records(NamedTuple):
    """train: periods of a multisine from rest, with noise; tests: a period of the steady motion, a sweep from rest."""

    train: Record
    tests: dict[str, Record]
    measured: bool


def load(fast: bool) -> Records:
    """The benchmark's records where they are found, else generated ones; fast: a part of each."""
    path = data_folder() / "bouc_wen" / "bouc_wen.npz"
    files = [] if path.is_file() else downloaded("BoucWen")
    measured = path.is_file() or bool(files)
    if path.is_file():
        found = read(path)
    else:
        found = generate(1024 if fast and not files else PERIOD, 6000 if fast or files else 153000) | tests_of(files)
    period = len(found["multisine_u"])
    samples = period if fast else 2 * period
    train = Record(found["train_u"][:samples], found["train_y"][:samples], period)
    end = 6000 if fast else None
    tests = {
        "multisine": Record(found["multisine_u"], found["multisine_y"], period),
        "sinesweep": Record(found["sinesweep_u"][:end], found["sinesweep_y"][:end], None),
    }
    return Records(train, tests, measured)


def read(path: Path):
    """The arrays of the file."""
    with np.load(path) as file:
        missing = [name for name in STORED if name not in file]
        if missing:
            raise ValueError(f"{path} does not hold {', '.join(missing)}: {HOW_TO_GET_IT}.")
        return {name: file[name] for name in STORED}


def tests_of(files):
    """The benchmark's own test records among files of its package; there is no training record of its own."""
    found = {}
    for file in files:
        name = Path(file).stem  # uval_multisine
        if name[1:5] == "val_" and f"{name[5:]}_{name[0]}" in STORED:
            (found[f"{name[5:]}_{name[0]}"],) = columns(file, name)
    return found


def generate(period, sweep):
    """The same from the equations: random-phase multisines of 5 to 150 Hz, 50 N rms, and a sweep of 40 N from 20 Hz."""
    rng = np.random.default_rng(0)
    frequency = np.fft.rfftfreq(period, DT)
    made = {}
    for name, periods in (("train", 5), ("multisine", 3)):
        inside = (frequency >= 5) & (frequency <= 150)
        u = np.fft.irfft(np.where(inside, np.exp(2j * np.pi * rng.random(frequency.size)), 0), period)
        u = np.tile(50 * u / u.std(), periods)
        made[f"{name}_u"] = u
        made[f"{name}_y"] = np.asarray(simulate(bouc_wen.BENCHMARK, reconstruct(u, period, FINEST), len(u), FINEST))
    made["train_y"] = made["train_y"] + NOISE * rng.normal(size=5 * period)
    made |= {name: made[name][-period:] for name in ("multisine_u", "multisine_y")}
    t = DT * np.arange(sweep)
    u = 40 * np.sin(2 * np.pi * (20 * t + 15 * t**2 / t[-1]))  # to 50 Hz
    y = simulate(bouc_wen.BENCHMARK, reconstruct(u, None, FINEST), sweep, FINEST)
    return made | {"sinesweep_u": u, "sinesweep_y": np.asarray(y)}


def reconstruct(u, period, substeps):
    """The input between its samples: band-limited where it is periodic, else a cubic spline."""
    if period is None:
        return hhtjax.sampled(jnp.asarray(u), DT)
    spectrum = np.fft.rfft(np.asarray(u)[:period])
    fine = substeps * np.fft.irfft(spectrum, substeps * period)
    return hhtjax.sampled(jnp.asarray(np.tile(fine, -(-len(u) // period))), DT / substeps)


def simulate(params, u, samples, substeps, alpha: Any = 0.0):
    """Displacement at `samples` samples from rest on, in m, by the non-iterative step."""
    system, given, q0, v0, _, z0 = bouc_wen.measured(params, u, None)
    run = hhtjax.simulate(
        system,
        hhtjax.hht(alpha, linearize="predictor"),  # smooth in the parameters
        q0,
        v0,
        given,
        z0=z0,
        dt=DT / substeps,
        num_steps=(samples - 1) * substeps,
        save_every=substeps,
    )
    return run.q[:, 0]


def score(params, record: Record, substeps, alpha: Any = 0.0):
    """Simulated output, and its RMSE in m; of a period, the third one from rest."""
    periods = 1 if record.period is None else 3
    u = np.tile(record.u, periods)
    output = simulate(params, reconstruct(u, record.period, substeps), len(u), substeps, alpha)
    output = np.asarray(output)[-len(record.y) :]
    return output, float(np.sqrt(np.mean((output - record.y) ** 2)))
