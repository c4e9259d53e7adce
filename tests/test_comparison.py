"""Models compared, on generated data: rates of rejection against 5 %, the true model found, errors against NumPy's."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy import stats
from test_uncertainty import coloured

import hhtjax
from hhtjax.identification.evidence import Residuals, chi_squared_tail, f_tail, residuals_of, used_by_starts, whiteness
from hhtjax.identification.result import student

N, RUNS = 1600, 300
k = jnp.arange(float(N))
COLUMNS = {"rest": jnp.ones(N), "slow": jnp.sin(0.02 * k), "slower": jnp.cos(0.013 * k), "fast": jnp.cos(0.9 * k)}
MODELS = {
    "small": ("rest",),
    "true": ("rest", "slow"),
    "large": ("rest", "slow", "slower"),
    "larger": ("rest", "slow", "slower", "fast"),
}


def model(params):
    return sum(params[name] * COLUMNS[name] for name in params)


def fitted(terms):
    """A function that fits a model to many records."""
    return jax.jit(jax.vmap(lambda y: hhtjax.fit(lambda p: model(p) - y, dict.fromkeys(terms, 0.1))))


FIT = {name: fitted(terms) for name, terms in MODELS.items()}


def many(noise, size):
    """A comparison for each of many records made with the parameters of "true"."""
    y = size * jax.jit(jax.vmap(noise))(jax.random.split(jax.random.key(0), RUNS))
    y = y + model({"rest": 0.5, "slow": 0.3})[None, :]
    # one after the other: batches of LAPACK's calls side by side can lock XLA:CPU
    every = {name: jax.device_get(fit(y)) for name, fit in FIT.items()}
    return [hhtjax.compare(jax.tree.map(lambda x: x[i], every)) for i in range(RUNS)]  # noqa: B023


@pytest.fixture(scope="module")
def white():
    return many(lambda key: jax.random.normal(key, (N,)), 1.0)


@pytest.fixture(scope="module")
def correlated():
    return many(lambda key: coloured(key, N), 0.15)


def rejected(found, smaller, larger):
    """Share of records in which the larger model is taken at the level of 5 %: by us, and by the textbook."""
    tests = [x for one in found for x in one.tests if (x.smaller, x.larger) == (smaller, larger)]
    assert len(tests) == RUNS
    return np.mean([[x.p_value < 0.05, x.naive_p_value < 0.05] for x in tests], axis=0)


def bic_share(found, name):
    """Share of records in which BIC takes a model, and in which it does with n in the place of the effective number."""
    ours = [one.names[int(np.argmin(one.bic))] == name for one in found]
    naive = [one.names[int(np.argmin(N * np.log(one.rms**2) + one.parameters * np.log(N)))] == name for one in found]
    return np.mean(ours), np.mean(naive)


@pytest.mark.slow
def test_white_noise(white):
    """Both tests have their size; the effective number is the number; BIC finds the truth."""
    ours, naive = rejected(white, "true", "large")
    assert 0.02 <= naive <= 0.08
    assert 0.02 <= ours <= 0.08
    assert np.median([one.effective for one in white]) > 0.9 * N
    assert np.mean(rejected(white, "small", "true")) == 1
    assert min(bic_share(white, "true")) > 0.9


@pytest.mark.slow
def test_correlated_noise(correlated):
    """AR(1) of 0.9: the textbook takes a slow term that is not there in most records, and refuses a fast one always."""
    ours, naive = rejected(correlated, "true", "large")
    assert 0.02 <= ours <= 0.08
    assert naive > 0.4
    ours, naive = rejected(correlated, "large", "larger")
    assert 0.02 <= ours <= 0.08
    assert naive < 0.01
    ours, naive = bic_share(correlated, "true")
    assert ours > 0.8
    assert naive < 0.75
    effective = np.median([one.effective for one in correlated])
    assert 50 < effective < 0.3 * N  # 84 for a constant, up to 16 times more for the others


@pytest.mark.slow
def test_errors_on_segments_left_out_are_those_of_numpy():
    """Rows left out of a linear least-squares problem, solved by NumPy; weights and missing samples with them."""
    y = model({"rest": 0.5, "slow": 0.3}) + 0.3 * coloured(jax.random.key(1), N)
    weights = np.where(np.arange(N) % 7 == 3, 0.0, 2.0)
    terms = {name: MODELS[name] for name in ("small", "true", "large")}

    def residuals(p):
        return model(p) - y

    results = {
        name: hhtjax.fit(residuals, dict.fromkeys(names, 0.1), weights=jnp.asarray(weights))
        for name, names in terms.items()
    }
    always = np.arange(N) < 100
    found = hhtjax.compare(results, residuals, folds=5, always=always)
    assert found.observations == np.sum(weights > 0)
    assert found.converged.all()
    for i, names in enumerate(terms.values()):
        X = np.stack([COLUMNS[name] for name in names], axis=1)
        for fold in range(5):
            out = (np.arange(N) // 320 == fold) & ~always
            kept = ~out & (weights > 0)
            p, *_ = np.linalg.lstsq(X[kept], np.asarray(y)[kept], rcond=None)
            left = 2 * (X @ p - np.asarray(y))[out & (weights > 0)]
            assert found.held_out[i, fold] == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-6)
    assert found.chosen == "true"
    assert "chosen: 'true'" in repr(found)
    assert "behind the best" in found._repr_html_()
    ax = hhtjax.plot.held_out(found, unit="V")
    np.testing.assert_allclose(ax.lines[3].get_xdata(), found.cross_validated[[0, 2]])
    np.testing.assert_allclose(ax.lines[4].get_xdata(), found.cross_validated[[1]])
    plt.close(ax.figure)


@pytest.mark.slow
def test_where_a_term_is_absent():
    """Against 0.3, not 0, a term of 0.3 is not significant; a smaller model that holds it fixed says so itself."""
    y = model({"rest": 0.5, "slow": 0.3}) + 0.1 * jax.random.normal(jax.random.key(2), (N,))

    def residuals(p):
        return model(p) - y

    start = {"rest": 0.1, "slow": 0.3}
    small = hhtjax.fit(lambda p: residuals(p | {"slow": 0.3}), {"rest": 0.1})
    held = hhtjax.fit(residuals, start, transforms={"rest": None, "slow": hhtjax.fixed})
    large = hhtjax.fit(residuals, start)
    unaware = hhtjax.compare({"small": small, "large": large})
    aware = hhtjax.compare({"small": small, "large": large}, absent={"slow": 0.3})
    (at_zero,), (given,) = unaware.tests, aware.tests
    (own,) = hhtjax.compare({"small": held, "large": large}).tests
    assert at_zero.p_value < 1e-6
    assert given.p_value == own.p_value > 0.01
    assert given.naive_p_value == own.naive_p_value > 0.01
    assert "against small, if `absent` is right" in unaware.summary()
    assert "absent" not in aware.summary()


def test_tails_of_distributions_are_those_of_scipy():
    for x, q, n in ((4.17, 1, 30), (0.3, 2, 29), (12.0, 3, 1500)):
        assert f_tail(x, q, n) == pytest.approx(stats.f.sf(x, q, n), rel=1e-9)
        assert chi_squared_tail(x, q) == pytest.approx(stats.chi2.sf(x, q), rel=1e-9)
    for x, q in ((0.0, 3), (1e-3, 1), (31.0, 20), (900.0, 401), (6000.0, 5000), (np.inf, 2)):
        assert chi_squared_tail(x, q) == pytest.approx(stats.chi2.sf(x, q), rel=1e-9)
    assert np.isnan(chi_squared_tail(np.nan, 3))
    assert np.isnan(f_tail(1.0, 3, 0))
    for degrees, level, rtol in (
        *((1, 0.95, 1e-4), (2, 0.99, 1e-4), (16, 0.95, 1e-4), (17, 0.95, 1e-4), (31, 0.68, 1e-4), (np.inf, 0.95, 1e-9)),
        *((1.36, 0.95, 0.03), (2.5, 0.95, 0.01), (16.4, 0.99, 1e-4)),
    ):
        assert student(level, degrees) == pytest.approx(stats.t.ppf((1 + level) / 2, degrees), rel=rtol)


def test_white_noise_is_white_in_19_of_20_records():
    rng, share = np.random.default_rng(0), {}
    for name, r in {"white": rng.normal(size=(300, 400)), "slow": rng.normal(size=(300, 401))}.items():
        r = r[:, 1:] + 0.3 * r[:, :-1] if name == "slow" else r
        found = [whiteness(Residuals([""], [x], [x], [np.ones_like(x, bool)])) for x in r[:, :, None]]
        share[name] = np.mean([p < 0.05 for _, p, _ in found])
        assert np.mean([rho for rho, _, _ in found]) == pytest.approx(0.3 / 1.09 if name == "slow" else 0, abs=0.02)
    assert 0.02 <= share["white"] <= 0.09
    assert share["slow"] > 0.9


def test_white_noise_with_gaps_is_white():
    """A record with a hole, and one of which every second sample and a whole column are missing; beside a few numbers
    and none."""
    rng, i = np.random.default_rng(0), np.arange(300)
    few = Residuals(["", ""], [], [np.ones((3, 1)), np.zeros((0, 2))], [np.ones((3, 1), bool), np.zeros((0, 2), bool)])
    assert whiteness(few) is None
    hole, second = (i < 80) | (i > 250), np.stack([i % 2 == 0, i < 0], axis=1)
    for present in (hole[:, None], second):
        records = present * rng.normal(size=(300, *present.shape))
        beside = [few._replace(weighted=[r, *few.weighted], present=[present, *few.present]) for r in records]
        found = [whiteness(x)[1] < 0.05 for x in beside]
        assert 0.02 <= np.mean(found) <= 0.09


def test_records_are_no_samples_that_follow_one_another():
    """More records than samples, each with noise that is slow in itself; nothing is compiled but the fit."""
    noise = 0.1 * np.random.default_rng(0).normal(size=(60, 24)).cumsum(axis=1)
    result = hhtjax.fit(
        lambda p, start, r: p * COLUMNS["rest"][:24] + start - r, 1.0, records=noise, starts=np.zeros(60)
    )
    rho, p, _ = whiteness(residuals_of(result))
    assert rho > 0.5
    assert p < 1e-6
    assert float(result.uncertainty.autocorrelated[0, 0]) > 1.5 * float(result.uncertainty.naive[0, 0])
    assert used_by_starts(result) == 60
    assert used_by_starts(result._replace(weights=np.arange(60) < 7)) == 7  # of records without data, none


@pytest.mark.slow
def test_a_summary_says_what_the_residuals_are_worth():
    """Observations and missing ones, rms of what is there, correlation, and estimates that are known together only."""
    y = coloured(jax.random.key(3), N)
    present = np.arange(N) % 16 > 0
    weights = jnp.where(present, 2.0, 0.0)

    def residuals(p):
        return {"u": p["a"] * COLUMNS["rest"] + p["b"] * (COLUMNS["rest"] + 0.01 * COLUMNS["slow"]) - y}

    result = hhtjax.fit(residuals, {"a": 0.1, "b": 0.1}, weights={"u": weights})
    text = result.summary()
    assert "observations: 1500 and 100 missing, as informative as " in text
    r = np.asarray(result.residual["u"])[present]
    assert f"residual: rms u {np.sqrt(np.mean(r**2)):.4g}; " in text
    assert f"weighted sum of squares {4 * np.sum(r**2) / 1498:.3g} per degree of freedom" in text
    assert "correlation at lag 1 +0.8" in text  # 0.9 but for the gaps
    assert "not white (Ljung-Box, 20 lags: p = 0)" in text
    assert "largest correlation: -1.000 between a and b" in text
    assert float(text.rpartition("condition number of the scaled Jacobian: ")[2]) > 100
    worth = float(text.partition("as informative as ")[2].split()[0])
    u = result.uncertainty
    assert worth == pytest.approx(1500 * 2 / np.trace(np.linalg.solve(u.naive, u.cluster)), rel=0.02)


def test_segments_without_residuals_are_none():
    """Of 10 samples, 8 segments of 2: five; and three where the first four are missing."""
    y = COLUMNS["rest"][:10] + 0.1 * jnp.sin(7.0 * jnp.arange(10.0))

    def residuals(p):
        return p["a"] * COLUMNS["rest"][:10] - y

    fits = {}
    for first, segments in ((0, 5), (4, 3)):
        fits = dict.fromkeys("ab", hhtjax.fit(residuals, {"a": 0.5}, weights=np.arange(10) >= first))
        found = hhtjax.compare(fits, residuals)
        assert found.held_out.shape == found.converged.shape == (2, segments)
        assert found.held_out.all()
    with pytest.raises(ValueError, match=r"`folds` must give two or more segments .* received 8, which gives 1"):
        hhtjax.compare(fits, residuals, always=np.arange(10) < 8)


def test_of_models_that_leave_nothing_the_one_of_fewer_parameters_is_chosen():
    def residuals(p):
        return p["a"] * COLUMNS["rest"] + p.get("b", 0.0) * COLUMNS["slow"] - 2.0 * COLUMNS["rest"]

    starts = {"larger": {"a": 2.0, "b": 0.0}, "smaller": {"a": 2.0}}
    found = hhtjax.compare({name: hhtjax.fit(residuals, start) for name, start in starts.items()})
    assert found.rms.tolist() == [0, 0]
    assert found.chosen == "smaller"
    assert found.aic[0] - found.aic[1] == pytest.approx(2.0)
    assert "nan" not in found.summary().partition("F test")[0]


def test_what_cannot_be_compared_is_named():
    y = model({"rest": 0.5})

    def residuals(p):
        return model(p) - y

    one = hhtjax.fit(residuals, {"rest": 0.1, "slow": 0.1})
    with pytest.raises(TypeError, match="compare: `fits` must be a dict of two or more FitResult; received dict"):
        hhtjax.compare({"one": one})
    with pytest.raises(ValueError, match=r"compare: `fits\['b'\]` must have a covariance"):
        hhtjax.compare({"a": one, "b": one._replace(uncertainty=None)})
    short = one._replace(residual=one.residual[:7])
    with pytest.raises(ValueError, match="same measurements; received 1600 of 'a', 7 of 'b' observations"):
        hhtjax.compare({"a": one, "b": short})
    with pytest.raises(ValueError, match="compare: `residuals` must have the keys a, b; received a"):
        hhtjax.compare({"a": one, "b": one}, {"a": residuals})
    with pytest.raises(ValueError, match="compare: `folds` must be an integer, 2 or more; received 1"):
        hhtjax.compare({"a": one, "b": one}, residuals, folds=1)
    with pytest.raises(ValueError, match=r"compare: `always` must have the leading axes .* \(1600,\); received \(3,\)"):
        hhtjax.compare({"a": one, "b": one}, residuals, always=np.ones(3, bool))
    with pytest.raises(ValueError, match="compare: `fits` must have the same weights; those of 'a' and 'b' differ"):
        hhtjax.compare({"a": one, "b": one._replace(weights=2.0)})
    both = {"a": one, "b": one}
    with pytest.raises(ValueError, match="compare: `absent` must have keys among rest, slow; received 'k'"):
        hhtjax.compare(both, absent={"k": 1.0})
    with pytest.raises(ValueError, match=r"`residuals` of 'b' must be those fitted, \(1600,\); received \(1599,\)"):
        hhtjax.compare(both, {"a": residuals, "b": lambda p: residuals(p)[1:]})
    with pytest.raises(ValueError, match=r"`residuals` of 'a' must be .* norm is .* received others, with norm 4\."):
        hhtjax.compare(both, lambda p: residuals(p) + 0.1)
    with pytest.raises(NotImplementedError, match=r"compare: `fits\['a'\]` has records"):
        hhtjax.compare({"a": one._replace(starts=jnp.ones((4, 1))), "b": one}, residuals)
    with pytest.raises(ValueError, match="held_out: `found` must have errors on segments"):
        hhtjax.plot.held_out(hhtjax.compare({"a": one, "b": one}))
    with pytest.raises(TypeError, match="held_out: `found` must be a Comparison"):
        hhtjax.plot.held_out(one)
