"""Cascaded tanks: the model against SciPy, its sticking sensor, and the loader."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from experiments.identification import tanks_data as data

HEADER = "uEst,uVal,yEst,yVal,Ts\n"


@pytest.mark.slow
def test_a_held_input_through_both_tanks_as_by_scipy():
    """Restarted at each jump of u there too; overflow of both tanks, with rims as smooth."""
    u = np.repeat([3.0, 7.0, 6.0, 0.5], 10)
    own = data.GENERATED | {"linear": 0.002, "rim": 9.0}

    def rates(t, x, pump):
        above = x - np.array([data.RIM, own["rim"]])
        over1, over2 = (above + np.sqrt(above**2 + 0.1**2)) / 2
        down = own["k2"] * (1 + own["caught"] * x[1]) * np.sqrt(x[0])
        lower = down + own["over"] * over1 - own["k3"] * np.sqrt(x[1]) - own["linear"] * x[1] - over2
        return own["k4"] * (pump - own["u0"]) - own["k1"] * np.sqrt(x[0]) - over1, lower

    levels = [(own["x1"], own["x2"])]
    for pump in u[:-1]:
        run = solve_ivp(rates, (0, data.DT), levels[-1], args=(pump,), rtol=1e-8, atol=1e-10, max_step=0.1)
        levels.append(tuple(run.y[:, -1]))
    levels = np.array(levels)
    assert levels[:, 0].max() > data.RIM
    assert levels[:, 1].max() > own["rim"]
    error = np.asarray(data.simulate(own, u, substeps=8)) - np.minimum(levels[:, 1], data.FULL)
    full = levels[:, 1] > 9
    assert np.max(np.abs(error[~full])) < 2e-3
    assert np.max(np.abs(error[full])) < 0.02  # the sensor's limit is smooth too


def test_the_reading_sticks_after_a_high_level_and_saturates():
    y = np.concatenate([np.linspace(4, 5, 20), np.linspace(5, 4, 20), np.linspace(4, 14, 20), np.linspace(14, 3, 80)])
    own = {"jump": 0.4, "stick": 6.0}
    off = np.asarray(data.reading(own, np.stack([np.full_like(y, 5.0), y], axis=1))) - y
    assert np.max(np.abs(off[:40])) < 2e-3  # not high enough
    falling = np.arange(60, 140)
    stuck = falling[(y[falling] > 5.4) & (y[falling] < 9)]
    assert off[stuck] == pytest.approx(0.4, abs=2e-3)
    assert np.max(np.abs(off[falling[y[falling] < 4.9]])) < 2e-3
    assert np.max(off + y) < data.FULL + 0.01
    lower = data.reading({"pressure": 0.5}, np.array([[9.0, 5.0], [4.0, 5.0]]))
    assert float(lower[1] - lower[0]) == pytest.approx(0.5, abs=1e-3)


def test_the_loader(tmp_path, monkeypatch):
    """The benchmark's own file, a wrong one, and none."""
    monkeypatch.setenv("HHTJAX_DATA", str(tmp_path))
    generated = data.load(fast=False)
    assert not generated.measured
    again = data.load(fast=True)
    for part, short in zip(generated[:2], again[:2], strict=True):
        assert part.u.shape == part.y.shape == (data.SAMPLES,)
        assert part.y.max() == pytest.approx(data.FULL, abs=0.1)  # some of it overflows
        assert np.array_equal(short.y, part.y[:400])
    path = tmp_path / "cascaded_tanks" / "tanks.csv"
    path.parent.mkdir()
    rows = np.arange(4 * data.SAMPLES, dtype=float).reshape(-1, 4)
    text = "\n".join(",".join(map(str, row)) + ",4" * (i == 0) + "," * (i > 0) for i, row in enumerate(rows))
    path.write_text(HEADER + text)
    found = data.load(fast=False)
    assert found.measured
    assert np.array_equal(np.stack([found.train.u, found.test.u, found.train.y, found.test.y], axis=1), rows)
    path.write_text(HEADER.replace("yVal", "y") + text)
    with pytest.raises(ValueError, match=r"no columns yVal: .*download .*nonlinearbenchmark"):
        data.load(fast=False)
    path.write_text(HEADER + "\n".join(text.splitlines()[:50]))
    with pytest.raises(ValueError, match=r"1024 rows of finite numbers; received shape"):
        data.load(fast=False)
