"""What a reader gets: the table, JSON and back, and answers to what-if questions, against refits."""

from collections import namedtuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hhtjax
from hhtjax.identification.refinement import Refined
from hhtjax.identification.result import FitResult

x = jnp.linspace(0.0, 1.0, 200)
Y = 2.0 * jnp.exp(-3.0 * x) + 0.3 + 0.05 * np.random.default_rng(0).normal(size=200)


def residuals(params):
    return {"y": params["a"] * jnp.exp(-params["rate"] * x) + params["rest"][0] - Y}


START = {"a": 1.0, "rate": 1.0, "rest": (0.3,)}
TRANSFORMS = {"a": hhtjax.positive, "rate": hhtjax.bounded(0, 10), "rest": hhtjax.fixed}


@pytest.fixture(scope="module")
def result():
    return hhtjax.fit(residuals, START, transforms=TRANSFORMS)


@pytest.mark.slow
def test_summary_and_json(result):
    lines = result.summary().splitlines()
    assert lines[0].startswith("converged: ")
    row = next(line for line in lines if line.startswith("rate")).split()
    assert float(row[1]) == pytest.approx(float(result.params["rate"]), rel=1e-5)
    assert float(row[2]) == pytest.approx(float(result.standard_errors["rate"]), rel=1e-2)
    assert next(line for line in lines if line.startswith("rest.0")).split()[2] == "fixed"
    assert any(line.startswith("largest correlation: +") and line.endswith("a and rate") for line in lines)
    again = FitResult.from_json(result.to_json())
    assert jax.tree.structure(again) == jax.tree.structure(result)
    jax.tree.map(np.testing.assert_array_equal, again, result)
    assert again.summary() == result.summary()
    numbered = result._replace(params={1: result.params["a"], (2, "b"): result.params["rate"]})
    assert FitResult.from_json(numbered.to_json()).params == numbered.params
    with pytest.raises(
        TypeError, match="to_json: `params` must be of dicts, lists, tuples and arrays; received a Mine"
    ):
        result._replace(params=namedtuple("Mine", "a")(1.0)).to_json()
    with pytest.raises(ValueError, match="from_json: `text` must be what to_json wrote; received a part None"):
        FitResult.from_json("{}")
    for text in ('{"array": 1}', '{"list": 3}', '{"FitResult": {"a": 1}}', '{"dict": [1]}'):
        with pytest.raises(ValueError, match="from_json: `text` must be what to_json wrote; a part of it is not"):
            FitResult.from_json(text)
    for kind, text, other in ((FitResult, "[1]", "list"), (Refined, result.to_json(), "FitResult")):
        with pytest.raises(ValueError, match=f"to_json of a {kind.__name__} wrote; received a {other}"):
            kind.from_json(text)
    surely = result._replace(uncertainty=jax.tree.map(jnp.zeros_like, result.uncertainty))
    assert "largest correlation: +0.000 between a and rate" in surely.summary()


@pytest.mark.slow
def test_profile_is_the_parabola_of_the_standard_error(result):
    """Naive errors, for which the white likelihood is right."""
    sigma = float(result.standard_errors["rate"])
    bare = result._replace(uncertainty=None)
    with pytest.raises(ValueError, match="prediction_errors: `result` must have a covariance"):
        hhtjax.identification.prediction_errors(lambda p: p["a"], bare)
    with pytest.raises(TypeError, match="prediction_errors: `result` must be a FitResult; received dict"):
        hhtjax.identification.prediction_errors(lambda p: p, {})
    with pytest.raises(ValueError, match=r"prediction_errors: `noise` must be 0 or more; received -1\.0"):
        hhtjax.identification.prediction_errors(lambda p: p, {}, noise=-1.0)
    with pytest.raises(TypeError, match=r"score_test: `residuals` is called as residuals\(params, candidates\)"):
        hhtjax.identification.score_test(lambda p: p, 1.0, 0.0)
    with pytest.raises(ValueError, match="profile: `result` must have a covariance"):
        hhtjax.identification.profile(residuals, bare, "rate", [1.0])
    unknown = result.uncertainty._replace(cluster=jnp.diag(jnp.array([jnp.inf, 4.0])))
    found = hhtjax.identification.prediction_errors(lambda p: (p["a"], p["rate"]), result._replace(uncertainty=unknown))
    assert tuple(map(float, found)) == (np.inf, 2.0)
    values = float(result.params["rate"]) + sigma * np.array([-1.0, 0.0, 1.0])
    found = hhtjax.identification.profile(residuals, result, "rate", values)
    np.testing.assert_allclose(found.deviance, [1, 0, 1], atol=0.06)
    with pytest.raises(ValueError, match=r"profile: `name` must be one of a, rate; received 'k'"):
        hhtjax.identification.profile(residuals, result, "k", values)


@pytest.mark.slow
def test_the_score_test_predicts_the_refit(capsys):
    def with_kink(params, candidates):
        return residuals(params | {"rest": (0.3,)})["y"] + (candidates["kink"] - 0.6) * jnp.maximum(x - 0.5, 0.0)

    absent = {"kink": 0.0}
    params = {"a": 1.0, "rate": 1.0}
    without = hhtjax.fit(lambda p: with_kink(p, absent), params, covariance=False)
    both = hhtjax.fit(lambda u: with_kink(*u), (params, absent), covariance=False)
    found = hhtjax.identification.score_test(with_kink, without.params, absent)
    assert found.names == ["kink"]
    assert found.statistic[0] > 10.8
    assert found.estimate[0] == pytest.approx(float(both.params[1]["kink"]), rel=0.2)
    assert found.cost_drop[0] == pytest.approx(1 - float(both.cost / without.cost), rel=0.2)
    there = hhtjax.identification.score_test(lambda p, c: with_kink(p | {"a": p["a"] + c}, absent), without.params, 0.0)
    assert (there.statistic[0], there.estimate[0]) == (0, 0)  # what is fitted already
    exact = hhtjax.identification.score_test(lambda p, c: p * x + c * x**2 - 2 * x, 2.0, 0.0, progress=True)
    assert "score_test: the residuals and their derivatives in 2 " in capsys.readouterr().err
    assert (exact.statistic[0], exact.cost_drop[0]) == (0, 0)
    twice = hhtjax.identification.score_test(lambda *x: [with_kink(*x)] * 2, without.params, absent)
    assert twice.statistic[0] == pytest.approx(found.statistic[0])  # the same errors again say nothing more


@pytest.mark.parametrize(("shape", "advised"), [(jnp.exp(-6 * x) * jnp.sin(80 * x), True), (jnp.sin(80 * x), False)])
def test_a_residual_that_fades_asks_for_other_starts(shape, advised):
    """As that of a friction fit in a false minimum; one that stays as large does not, nor one that is white."""
    noise = 0.001 * np.random.default_rng(1).normal(size=200)
    said = [hhtjax.fit(lambda level, y=y: level - y, 0.3).summary() for y in (shape + noise, jnp.asarray(noise))]
    assert ["multistart" in text and "windows" in text for text in said] == [advised, False]
