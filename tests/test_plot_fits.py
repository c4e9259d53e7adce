"""Charts of fits: residuals, spectra, estimates with intervals, correlations, a profile."""

import matplotlib as mpl
import numpy as np
import plotted_runs
import pytest

import hhtjax
from hhtjax import plot

mpl.use("Agg")
import matplotlib.pyplot as plt


@pytest.fixture(autouse=True)
def closed():
    """No test leaves a figure behind."""
    yield
    plt.close("all")


@pytest.fixture
def result():
    return plotted_runs.fit()


def test_fit_against_data_shows_residual_and_spectrum():
    t = np.arange(512) / 100
    model, tone = np.sin(t), 0.1 * np.sin(2 * np.pi * 12.5 * t)
    upper, middle, lower = plot.fit_against_data(t, model + tone, model, unit="mV", ylabel="voltage", show=(1.0, 2.0))
    assert [line.get_label() for line in upper.lines] == ["measured", "simulated"]
    assert (upper.get_ylabel(), middle.get_ylabel()) == ("voltage (mV)", "residual (mV)")
    np.testing.assert_allclose(middle.lines[0].get_ydata(), tone[100:201], atol=1e-12)
    frequency, density = lower.lines[1].get_data()
    assert abs(frequency[np.argmax(density)] - 12.5) < 0.2
    power = np.sum(density**2) * (frequency[1] - frequency[0])
    assert abs(power - 0.005) < 2e-4  # half the square of the amplitude
    axes = plt.subplots(2)[1]
    assert plot.fit_against_data(t, model + tone, model, names=("a", "b"), ax=axes).tolist() == axes.tolist()
    np.testing.assert_array_equal(axes[1].lines[0].get_ydata(), model + tone - model)
    assert [line.get_label() for line in axes[0].lines] == ["a", "b"]


@pytest.mark.slow
def test_estimates_are_relative_to_estimate_or_truth(result):
    ax = plot.estimates(result)
    assert [text.get_text() for text in ax.get_yticklabels()] == [f"{n} = {result.params[n]:.4g}" for n in "ab"]
    ((left, right), _) = (sorted(bar[:, 0]) for bar in ax.collections[0].get_segments())
    lower, upper = result.interval()
    np.testing.assert_allclose([left, right], [100 * (x["a"] / result.params["a"] - 1) for x in (lower, upper)])
    ax = plot.estimates({"one": result, "two": result}, truth={"a": 2.0, "b": 0.5}, entries="b", level=0.9)
    assert ax.get_xlabel() == "90 % interval (% of the truth)"
    np.testing.assert_allclose(ax.containers[1].lines[0].get_xdata(), 100 * (result.params["b"] / 0.5 - 1))
    with pytest.raises(ValueError, match=r"estimates: `b` is 0"):
        plot.estimates(result, truth={"a": 2.0, "b": 0.0})


def test_a_gap_is_no_step_in_the_spectrum():
    """Noise about 100, of which a quarter is missing: less of it is left, and nothing more."""
    noise = np.random.default_rng(0).normal(size=512)
    gap = np.where(np.arange(512) // 128 == 1, np.nan, 100 + noise)
    frequency, density = plot.fit_against_data(np.arange(512.0), gap, np.zeros(512))[2].lines[0].get_data()
    np.testing.assert_allclose(np.sum(density**2) * frequency[0], 0.75, rtol=0.2)


def test_a_fit_on_one_page(result):
    axes = plot.fit_overview(result, 10.0, unit="V")
    np.testing.assert_array_equal(axes[0].lines[0].get_ydata(), result.residual)
    assert axes[0].lines[0].get_xdata()[-1] == 19.9
    frequency, density = axes[1].lines[0].get_data()
    np.testing.assert_allclose(np.sum(density**2) * frequency[0], np.var(result.residual), rtol=0.2)
    assert [text.get_text() for text in axes[2].get_yticklabels()] == [f"{n} = {result.params[n]:.4g}" for n in "ab"]
    np.testing.assert_allclose(axes[3].images[0].get_array(), result.correlation)
    assert [ax.get_ylabel() for ax in result.plot(10.0).axes[:1]] == ["residual"]
    assert len(plot.fit_overview(result._replace(uncertainty=None))) == 2
    records = result._replace(residual=result.residual.reshape(20, 10), starts=np.zeros(20))
    np.testing.assert_array_equal(plot.fit_overview(records)[0].lines[0].get_ydata(), records.residual[0])


def test_correlations_and_profile(result):
    ax = plot.correlations(result)
    np.testing.assert_allclose(ax.images[0].get_array(), result.correlation)
    assert ax.texts[0].get_text() == "1.00"
    a, error = float(result.params["a"]), float(result.standard_errors["a"])
    values = np.linspace(a - 2 * error, a + 2 * error, 5)
    found = hhtjax.identification.Profile(values, None, ((values - a) / error) ** 2)
    ax = plot.profile(found, name="a", unit="m", result=result)
    assert ax.get_xlabel() == "a (m)"
    on_parabola = np.interp(values, *ax.lines[1].get_data())
    np.testing.assert_allclose(on_parabola, found.deviance, atol=2e-2)
    assert ax.lines[2].get_ydata()[0] == 3.84
