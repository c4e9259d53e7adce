"""Silverbox's candidate terms: the model with them against SciPy, and the choice."""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hhtjax
from experiments.identification import silverbox_terms as terms
from experiments.identification.data import SAMPLING_RATE


@pytest.mark.slow
def test_the_terms_as_by_scipy():
    """Forces, internal states and the reading."""
    u = hhtjax.sampled(0.1 * np.sin(0.6 * np.arange(40.0)), 1 / SAMPLING_RATE)
    own = {"m": 5.4e-6, "c": 2.2e-4, "k": 1.0, "k2": -0.03, "k3": 4.0, "offset": -5e-3}
    extra = {"relaxing": 0.05, "relaxing_cubic": 2.0, "drift": 1.0, "v3": 2e-7, "d2": 1e-4, "above": 3.0, "c4": 0.1}
    own |= extra | {"amplitude_lag": -6e-4, "bent": 0.1}
    force = jax.jit(u)

    def rates(t, state):
        y, v, x, s = state
        cubic = own["k2"] * y**2 + own["k3"] * y**3 + own["relaxing"] * x + own["relaxing_cubic"] * y**2 * x
        Q = float(force(t)) + own["offset"] - own["c"] * v - own["k"] * y - cubic - own["drift"] * y * s
        Q -= own["v3"] * v**3 + own["d2"] * y**2 * abs(v) * v + own["c4"] * y**4 * v
        Q -= own["above"] * max(abs(y) - 0.15, 0) ** 2 * np.sign(y)
        return v, Q / own["m"], (y - x) / terms.FAST, (y**2 - s) / terms.SLOW

    t = np.arange(40) / SAMPLING_RATE
    run = solve_ivp(rates, (0, t[-1]), (0.2, 20.0, 0.0, 0.0), t_eval=t, rtol=1e-8, atol=1e-10)
    y, v = run.y[:2]
    assert np.max(np.abs(y)) > 0.16
    found = terms.simulate(own, {"y": 0.2, "v": 20.0}, u, 40, substeps=16)
    assert np.max(np.abs(np.asarray(found) - y - own["bent"] * y**2 - own["amplitude_lag"] * y**2 * v)) < 1e-5


def test_the_first_candidate_of_each_kind_is_tried_if_it_promises_enough():
    drop = {"v3": 6.0, "coulomb": 5.0, "relaxing": 4.0, "drift": 3.0, "bent": 2.1, "k5": 1.9}
    ranking = {name: {"cost_drop_percent": x} for name, x in drop.items()}
    assert terms.first_of_each(ranking) == ["v3", "relaxing", "bent"]
    assert set().union(*terms.KINDS) == set(terms.CANDIDATES)
