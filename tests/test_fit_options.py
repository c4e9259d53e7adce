"""Transforms, weights, robust losses, priors, many starts: each against an independent calculation."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares

import hhtjax
from hhtjax.identification.least_squares import BAD_START

t = jnp.linspace(0.0, 3.0, 40)
NOISE = 0.02 * np.random.default_rng(1).normal(size=t.size)
TRUE = {"a": 2.0, "rate": 1.5, "offset": 0.5}


def model(params):
    return params["a"] * jnp.exp(-params["rate"] * t) + params["offset"]


MEASURED = model(TRUE) + NOISE


def residuals(params):
    return model(params) - MEASURED


@pytest.mark.slow
def test_transforms_keep_parameters_where_they_belong():
    """The same minimum in other coordinates, with the same errors; a bound that is felt; a fixed leaf untouched."""
    start = {"a": 20.0, "rate": 0.1, "offset": 0.0}
    plain = hhtjax.fit(residuals, TRUE)
    logs = hhtjax.fit(residuals, start, transforms={"a": hhtjax.positive, "rate": hhtjax.positive, "offset": None})
    for name in TRUE:
        assert float(logs.params[name]) == pytest.approx(float(plain.params[name]), rel=1e-5)
        assert float(logs.standard_errors[name]) == pytest.approx(float(plain.standard_errors[name]), rel=1e-3)
    lower, upper = logs.interval()
    ratios = [upper["rate"] / logs.params["rate"], logs.params["rate"] / lower["rate"]]
    reach = stats.t.ppf(0.975, logs.uncertainty.degrees[2]) * logs.standard_errors["rate"]
    np.testing.assert_allclose(ratios, np.exp(reach / logs.params["rate"]), rtol=1e-3)

    felt = hhtjax.fit(
        residuals, start, transforms={"a": hhtjax.bounded(0.0, 30.0), "rate": hhtjax.fixed, "offset": hhtjax.fixed}
    )
    assert felt.params["rate"] == 0.1
    assert felt.standard_errors["rate"] == 0
    shape = np.exp(-0.1 * t)
    assert float(felt.params["a"]) == pytest.approx(float(shape @ MEASURED / (shape @ shape)), rel=1e-6)
    assert felt.interval()[0]["rate"] == 0.1


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_no_coordinate_leaves_the_domain_of_its_transform(dtype):
    """However far a fit has run, the next one may start there."""
    for T in (hhtjax.positive, *(hhtjax.bounded(a, a + 1) for a in (-1, 0, 2))):
        p = T.parameter(jnp.array([-1e4, 0.0, 80.0], dtype), 1.0)
        assert p.dtype == dtype
        assert T.contains(p).all()
        assert np.isfinite(T.coordinate(p, 1.0)).all()
        assert T.parameter(T.coordinate(p, 1.0), 1.0)[1] == pytest.approx(float(p[1]))
        _, slope = jax.jvp(
            lambda x, T=T: T.parameter(x, 1.0), (jnp.array([-25.0, 25.0], dtype),), (jnp.ones(2, dtype),)
        )
        assert np.all(slope > 0)


@pytest.mark.slow
@pytest.mark.parametrize("in_records", [False, True])
def test_parameters_that_end_at_their_bounds(in_records):
    """An upper and a lower one, beyond which the free optimum lies: found as by SciPy, intervals cut off there."""
    x = jnp.linspace(-1.0, 1.0, 40).reshape(2, 20)
    measured = 2 * x - jnp.cos(3 * x) + jnp.array([[0.3], [0.4]]) + NOISE.reshape(2, 20)
    bounds = {"a": hhtjax.bounded(0.0, 1.5), "c": hhtjax.positive}

    def off(params, offset, record):
        x, measured = record
        return params["a"] * x + params["c"] * jnp.cos(3 * x) + offset - measured

    def one_by_one(params):
        return off(params, params["b"][:, None], (x, measured))

    if in_records:
        result = hhtjax.fit(off, {"a": 1.0, "c": 1.0}, records=(x, measured), starts=jnp.zeros(2), transforms=bounds)
        found = result.starts
    else:
        result = hhtjax.fit(one_by_one, {"a": 1.0, "b": jnp.zeros(2), "c": 1.0}, transforms=bounds | {"b": None})
        found = result.params["b"]
    known = least_squares(
        lambda y: np.asarray(one_by_one({"a": y[0], "c": y[1], "b": y[2:]})).ravel(),
        [1.0, 1.0, 0.0, 0.0],
        bounds=([0, 0, -np.inf, -np.inf], [1.5, np.inf, np.inf, np.inf]),
        xtol=1e-14,
    )
    assert result.converged
    assert int(result.iterations) < 30
    assert float(result.cost) == pytest.approx(known.cost, rel=1e-7)
    np.testing.assert_allclose(found, known.x[2:], rtol=1e-6)
    lower, upper = result.interval()
    assert (float(upper["a"]), float(lower["c"])) == (1.5, 0.0)
    reach = stats.t.ppf(0.975, result.uncertainty.degrees[-1]) * result.standard_errors["c"]
    assert float(upper["c"]) == pytest.approx(float(reach), rel=0.01)
    assert "at a bound: a, c; " in result.summary()


@pytest.mark.slow
def test_missing_samples_and_weights():
    """A missing sample, NaN or not, is as good as none; a weight of 2 as good as four samples."""
    gone = np.arange(t.size) % 3 == 0
    holes = jnp.where(gone, jnp.nan, MEASURED)

    def with_holes(params):
        return {"y": jnp.stack([model(params) - holes, params["a"] - 2.1 + 0 * t], axis=1)}

    def without(params):
        once = (model(params) - MEASURED)[~gone]
        return jnp.concatenate([*4 * [once], 0.5 * (params["a"] - 2.1 + 0 * t)])

    weights = {"y": jnp.stack([jnp.where(gone, 0.0, 2.0), 0.5 + 0 * t], axis=1)}
    result, expected = hhtjax.fit(with_holes, TRUE, weights=weights), hhtjax.fit(without, TRUE)
    for name in TRUE:
        assert float(result.params[name]) == pytest.approx(float(expected.params[name]), rel=1e-6)
    assert np.isnan(result.residual["y"][0, 0])
    assert np.isfinite(result.covariance).all()


SPOILT = MEASURED.at[jnp.array([3, 20, 33])].add(jnp.array([5.0, -4.0, 8.0]))


def weighted(params):
    return (model(params) - SPOILT) / 0.02


def test_a_robust_fit_is_scipys():
    result = hhtjax.fit(weighted, TRUE, loss="cauchy", covariance=False, tolerance=1e-12)
    compiled = jax.jit(lambda x: weighted(dict(zip(TRUE, x, strict=True))))
    scipys = least_squares(lambda x: np.asarray(compiled(x)), list(TRUE.values()), loss="cauchy", xtol=1e-14)
    assert float(result.cost) == pytest.approx(scipys.cost, rel=1e-6)
    np.testing.assert_allclose([result.params[name] for name in TRUE], scipys.x, rtol=1e-4)
    assert abs(result.params["offset"] - 0.5) < 0.02


def test_a_prior_is_one_more_measurement():
    """Linear, so that Bayes' rule gives mean and covariance."""
    X = np.random.default_rng(2).normal(size=(30, 2))
    y = X @ [1.0, -2.0] + np.random.default_rng(3).normal(size=30)

    def residuals(p):
        return X @ p - y

    result = hhtjax.fit(residuals, jnp.zeros(2), prior=hhtjax.Gaussian(jnp.array([1.1, 0.0]), np.array([0.1, np.inf])))
    precision = X.T @ X + np.diag([100.0, 0.0])
    np.testing.assert_allclose(result.params, np.linalg.solve(precision, X.T @ y + [110.0, 0.0]), rtol=1e-6)
    assert float(result.standard_errors[0]) < 0.1 < np.sqrt(np.linalg.inv(X.T @ X)[0, 0])
    for deviation, unknowns in ((1e6, 2), (1e-6, 1)):  # that says nothing of the first parameter, or all
        prior = hhtjax.Gaussian(jnp.array([1.1, 0.0]), np.array([deviation, np.inf]))
        result = hhtjax.fit(residuals, jnp.zeros(2), prior=prior)
        variance = (
            np.sum(result.residual**2) / (30 - unknowns) * np.linalg.inv((X.T @ X)[2 - unknowns :, 2 - unknowns :])
        )
        np.testing.assert_allclose(result.uncertainty.naive[-1, -1], variance[-1, -1], rtol=1e-6)


@pytest.mark.slow
def test_many_starts_find_the_lowest_minimum(capfd):
    """One of them is none, which inside vmap is a flag. Progress is one line for all."""

    def wave(frequency):
        return jnp.sin(frequency * t) - jnp.sin(6.0 * t) + 0 * jnp.log(frequency)

    starts = jnp.linspace(1.0, 12.0, 8).at[4].set(-1.0)
    found = hhtjax.multistart(wave, starts, covariance=False, progress=True)
    jax.effects_barrier()
    shown = capfd.readouterr().err
    assert shown.count("\n") == 1
    lowest = [float(x) for x in re.findall(r"lowest cost ([^\s;]+)", shown)]
    assert len(lowest) == int(np.max(found.all.iterations)) + 1
    assert lowest == sorted(lowest, reverse=True)
    assert lowest[-1] == pytest.approx(float(found.best.cost), abs=1e-20)
    assert shown.rstrip().endswith("; all starts have ended")
    alone = [hhtjax.fit(wave, x, covariance=False).cost for x in starts[:2]]
    np.testing.assert_allclose(found.all.cost[:2], alone, rtol=1e-9)
    assert float(found.best.params) == pytest.approx(6.0, abs=1e-6)
    assert float(np.nanmax(found.all.cost[:4])) > 1.0
    assert found.best.history.cost.shape == (int(found.best.iterations) + 1,)
    np.testing.assert_array_equal(np.flatnonzero(found.all.code == BAD_START), [4])


@pytest.mark.slow
def test_a_start_without_influence_is_no_best_one():
    """Its cost is the lowest, and no derivative leads away from it."""

    def residuals(p):
        return jnp.where(p < 0, 0.1, p - 2.0 + jnp.array([1.0, -1.0, 1.0]))

    found = hhtjax.multistart(residuals, jnp.array([-1.0, 1.0]))
    assert float(found.best.params) == pytest.approx(5 / 3)
    for question in (lambda x: x.standard_errors, lambda x: x.reason, lambda x: x.interval(), lambda x: x.summary()):
        with pytest.raises(ValueError, match=r"FitResult: must hold one fit; received a batch of shape \(2,\)"):
            question(found.all)
    member = jax.tree.map(lambda x: x[1], found.all)
    assert member.summary().splitlines()[2] == found.best.summary().splitlines()[2]
    with pytest.raises(ValueError, match="multistart: `residuals` must depend on params"):
        hhtjax.multistart(residuals, jnp.array([-1.0, -2.0]))


def test_many_parameters_take_an_optax_optimiser():
    """The program of 100 parameters is one reverse pass, and no Jacobian of 100 columns."""
    target = jnp.linspace(1.0, 2.0, 100)
    with jax.numpy_dtype_promotion("standard"):  # optax does not compute under strict promotion
        result = hhtjax.fit(lambda p: p - target, jnp.ones(100), covariance=False)
    assert result.history.damping is None
    np.testing.assert_allclose(result.params, target, rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"transforms": hhtjax.fixed}, ValueError, "`transforms` must leave a parameter free"),
        (
            {"transforms": {"a": hhtjax.positive, "b": None}},
            ValueError,
            "`transforms` must have keys of params0, 'a', 'offset', 'rate'; received 'b'.",
        ),
        (
            {"transforms": [hhtjax.positive]},
            ValueError,
            "`transforms` must be a prefix of params0: pytree structure error",
        ),
        (
            {"transforms": {"a": hhtjax.bounded(np.zeros(2), 3)}},
            ValueError,
            r"`params0\['a'\]` must have the shape of the bounds in `transforms`; received \(\)",
        ),
        ({"transforms": "log"}, TypeError, "`transforms` must hold hhtjax.positive, .* received 'log'"),
        (
            {"transforms": {"a": None, "rate": hhtjax.bounded(2, 3), "offset": None}},
            ValueError,
            r"`params0\['rate'\]` must lie between 2.0 and 3.0, for its transform; received 1.5",
        ),
        (
            {"transforms": {"a": None, "rate": (0, 5), "offset": None}},
            TypeError,
            r"`transforms` must hold hhtjax.positive, .* or None; received 0 as transforms\['rate'\]\[0\]",
        ),
        (
            {"prior": {"a": None, "rate": (1.0, 0.5), "offset": None}},
            TypeError,
            r"`prior` must hold Gaussian\(mean, deviation\) or None; received 1.0 as prior\['rate'\]\[0\]",
        ),
        ({"weights": None}, TypeError, "`weights` must be a number, an array or a pytree of them; received None"),
        ({"weights": -1.0}, ValueError, "`weights` must not be negative; received -1.0"),
        ({"weights": np.ones(7)}, ValueError, r"`weights` must have the leading axes .* \(40,\); received \(7,\)"),
        ({"loss": "hubert"}, ValueError, "`loss` must be one of huber, soft_l1, cauchy, a function .* 'hubert'"),
        ({"prior": {"a": 1.0, "rate": None, "offset": None}}, TypeError, "`prior` must hold Gaussian.* received 1.0"),
        ({"prior": hhtjax.Gaussian(0.0, -1.0)}, ValueError, "`prior` must have a positive deviation; received -1.0"),
        ({"prior": hhtjax.Gaussian(np.nan, 1.0)}, ValueError, "the mean in `prior` must be finite; received nan"),
        ({"prior": hhtjax.Gaussian(0.0, "1")}, TypeError, "`prior` must have a real deviation; received '1'"),
        (
            {"prior": hhtjax.Gaussian(np.ones(2), 1.0)},
            ValueError,
            r"`prior` must have the shape of its parameter, \(\); received \(2,\)",
        ),
        ({"prior": {"a": None}}, ValueError, "`prior` must be a prefix of params0"),
        ({"weights": [1.0] * 40}, ValueError, "`weights` must be a prefix of what `residuals` return"),
        ({"segments": 1}, ValueError, "`segments` must be an integer, 2 or more; received 1"),
    ],
)
def test_bad_options_are_named(options, error, message):
    with pytest.raises(error, match=f"fit: {message}"):
        hhtjax.fit(residuals, TRUE, **options)


def test_bad_starts_and_bounds_are_named():
    with pytest.raises(ValueError, match="bounded: `lower` must be less than upper; received 2 and 1"):
        hhtjax.bounded(2, 1)
    with pytest.raises(ValueError, match="bounded: a bound must be finite; received None and None"):
        hhtjax.bounded()
    with pytest.raises(ValueError, match="bounded: `upper` must be finite, or inf for no bound; received nan"):
        hhtjax.bounded(0, np.nan)
    with pytest.raises(TypeError, match=r"bounded: `lower` must be a real number, an array of them, or None; .* '0'"):
        hhtjax.bounded("0", 1)
    with pytest.raises(ValueError, match="multistart: `starts` must have the same leading axis in all leaves"):
        hhtjax.multistart(residuals, TRUE)
    with pytest.raises(ValueError, match="multistart: `starts` must hold at least one number"):
        hhtjax.multistart(residuals, jnp.zeros(0))
    with pytest.raises(
        ValueError, match=r"multistart: `starts` must be positive, for its transform; received \[ 1. -1.\]"
    ):
        hhtjax.multistart(lambda p: p - t, jnp.array([1.0, -1.0]), transforms=hhtjax.positive)


def test_transforms_of_some_keys_leave_the_others_alone():
    """As if None had been written for these, in a branch too."""

    def nested(params):
        return model(params["inner"]) - MEASURED

    given = hhtjax.fit(nested, {"inner": TRUE}, transforms={"inner": {"a": hhtjax.positive}}, covariance=False)
    assert given.converged
    names = ["a", "offset", "rate"]  # in the order of JAX
    assert [type(T).__name__ for T in given.transforms] == ["Positive" if n == "a" else "Scaled" for n in names]


@pytest.mark.slow
def test_bounds_are_arrays_and_one_sided():
    """Each entry has its own: between, below, above, none; found as by SciPy, and kept by JSON."""
    data = np.array([[1.0, 2.0, 3.0, 4.0], [1.2, 2.4, 3.1, 4.0]])
    lower, upper = np.array([0.0, -np.inf, 3.2, -np.inf]), np.array([0.8, 1.5, np.inf, np.inf])
    transform = hhtjax.bounded(lower, upper)
    result = hhtjax.fit(lambda p: p[None, :] - data, jnp.array([0.5, 0.5, 3.5, 0.1]), transforms=transform)
    start = np.array([0.5, 0.5, 3.5, 0.1])
    known = least_squares(lambda x: (x - data).ravel(), start, bounds=(lower, upper), xtol=1e-14, ftol=1e-14)
    np.testing.assert_allclose(result.params, known.x, rtol=1e-5)
    assert transform.contains(result.params).all()
    ends = np.array(result.interval())
    assert (ends[0] >= lower).all()
    assert (ends[1] <= upper).all()
    assert hhtjax.FitResult.from_json(result.to_json()).transforms == result.transforms
    for one, start, end in ((hhtjax.bounded(lower=4), 5.0, 4.0), (hhtjax.bounded(upper=2), -3.0, 2.0)):
        assert float(hhtjax.fit(lambda p: p - data[0, 1:3], start, transforms=one).params) == pytest.approx(
            np.clip(2.5, *((end, 9) if end == 4 else (-9, end))), abs=1e-4
        )


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_coordinates_of_bounds_and_back(dtype):
    """The inverse; bend is p''/p' by differentiation; nothing leaves the bounds."""
    T = hhtjax.bounded(np.array([0.0, -np.inf, 3.2, -np.inf]), np.array([0.8, 1.5, np.inf, np.inf]))
    x = jnp.array([-0.7, 0.4, 0.9, 2.0], dtype)
    p = T.parameter(x, 1.0)
    assert p.dtype == T.coordinate(p, 1.0).dtype == T.bend(x).dtype == dtype
    np.testing.assert_allclose(T.coordinate(p, 1.0), x, rtol=1e-5)
    slope = lambda x: jax.jvp(lambda x: T.parameter(x, 1.0), (x,), (jnp.ones_like(x),))[1]  # noqa: E731
    first, second = jax.jvp(slope, (x,), (jnp.ones_like(x),))
    np.testing.assert_allclose(T.bend(x), second / first, rtol=1e-4, atol=1e-6)
    for far in (-1e4, 1e4):
        assert T.contains(T.parameter(jnp.full(4, far, dtype), 1.0)).all()


def test_bounded_parameters_as_free_numbers_and_back():
    transforms = {"k": hhtjax.positive, "c": hhtjax.bounded(0, 1), "m": hhtjax.fixed}
    params = {"k": jnp.array([2.0, 3.0]), "c": 0.25, "m": 7.0}
    free = hhtjax.identification.unconstrained(params, transforms)
    assert free.x0.shape == (3,)
    jax.tree.map(lambda p, given: np.testing.assert_allclose(p, given, rtol=1e-12), free.params(free.x0), params)
    far = free.params(free.x0 - 50)
    assert 0 < far["c"] < 1e-12
    assert float(far["m"]) == 7
    assert np.all((far["k"] > 0) & (far["k"] < 1e-12))
    with pytest.raises(ValueError, match="unconstrained: `transforms` must leave a parameter free"):
        hhtjax.identification.unconstrained({"m": 7.0}, hhtjax.fixed)
    with pytest.raises(ValueError, match=r"unconstrained: `params0\['c'\]` must lie between 0.0 and 1.0"):
        hhtjax.identification.unconstrained(params | {"c": 2.0}, transforms)
