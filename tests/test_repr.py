"""What a result shows in a notebook: shapes, dtypes and verdicts, never arrays; of tracers too, without computing."""

import pickle
import re

import jax
import jax.numpy as jnp
import jedi
import numpy as np
import pytest

import hhtjax
from hhtjax import Events, Failure, FitResult, Info, Interpolant, Solution, State
from hhtjax.description.presentation import MOST, overwrite, shown
from hhtjax.identification import History, ModeBias, Uncertainty
from hhtjax.identification.least_squares import COST, LIMIT
from hhtjax.identification.transforms import fixed, scaled

VALUE = 0.123456789  # of every array here


def run(batch=(), failed=0, quantity=1, newton=False, saved=501, dt=0.01, **changed):
    """A run as `simulate` returns it, or a batch of them, of which the last one fails at the step `failed`."""
    steps = np.zeros(batch, np.int32)
    steps[(-1,) * len(batch)] = failed
    t = jnp.broadcast_to(dt * jnp.arange(float(saved)), (*batch, saved))
    q = jnp.full((*batch, saved, 1), VALUE)
    failure = Failure(jnp.asarray(steps), jnp.full(batch, newton), jnp.full(batch, quantity, jnp.int32))
    return Solution(t, q, q, q, None, jnp.full(batch, dt), Info(), failure)._replace(**changed)


def fitted(params=None, code=COST, transforms=(scaled, scaled), variance=(0.01, jnp.inf), **changed):
    """A `FitResult`, without a fit."""
    params = {"k": jnp.asarray(2.0), "c": jnp.asarray(0.5)} if params is None else params
    covariance = jnp.diag(jnp.asarray(variance))
    believed = Uncertainty(covariance, covariance, covariance, jnp.ones(2), jnp.eye(2), jnp.zeros(2, bool))
    history = History(jnp.ones(6), jnp.ones(6), None)
    residual, five = {"angle": jnp.full(100, VALUE)}, jnp.asarray(5, jnp.int32)
    result = FitResult(params, residual, jnp.asarray(0.25), history, five, jnp.asarray(code), transforms, believed, 32)
    return result._replace(**changed)


def test_a_run_tells_how_many_events_there_were():
    def events(count, kept=100):
        rows = jnp.full((*np.shape(count), kept), VALUE)
        return Events(jnp.asarray(count), rows, rows, *[None] * 4, rows)

    def told(found, **changed):
        return repr(run(events=found, **changed)).splitlines()[0].partition("; ")[2]

    assert [told(events(n)) for n in (0, 1, 2)] == [
        f"every step finite; {n}" for n in ("0 events", "1 event", "2 events")
    ]
    assert told(events(150)) == "every step finite; 150 events, 100 kept"
    assert told(events([3, 5]), batch=(2,)) == "every step finite; 3 ... 5 events"
    assert told(events([1, 1], 4), batch=(2,)) == "every step finite; 1 event"
    assert repr(events(1)).startswith("Events(1 event, count=1, t=float64[100]")
    assert "event" not in told(None)
    assert told(events(2)._replace(count=None)) == told(events(2)._replace(t=None)) == "every step finite"


def test_a_run_in_a_few_lines():
    assert repr(run()) == str(run())
    assert repr(run()).splitlines() == [
        "Solution: 501 saved times, t = 0 ... 5 s, dt = 0.01 s; every step finite",
        "                  shape     dtype",
        "    q             (501, 1)  float64",
        "    v             (501, 1)  float64",
        "    acceleration  (501, 1)  float64",
    ]
    converged = Info(iterations=jnp.ones(500, jnp.int32), converged=jnp.ones(500, bool))
    text = repr(run(info=converged, q={"angle": jnp.ones(501), "hub": {"x": jnp.ones((501, 2), np.float32)}}))
    assert "every step finite, and converged" in text
    assert re.search(r"q\.angle +\(501,\) +float64\n +q\.hub\.x +\(501, 2\) +float32\n", text)
    assert re.search(r"info\.converged +\(500,\) +bool", text)
    text = repr(run(z={"current": jnp.ones((501, 2))}, zdot={"current": jnp.ones((501, 2))}))
    assert re.search(r"z\.current +\(501, 2\) +float64\n +zdot\.current +\(501, 2\) +float64$", text)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_run_says_what_check_says(batch):
    for newton in (False, True):
        spoilt = run(batch, failed=7, newton=newton)
        with pytest.raises(hhtjax.SimulationError) as error:
            spoilt.check()
        told = str(error.value).removeprefix("simulate: ").partition(". ")[0]
        title = repr(spoilt).splitlines()[0]
        assert title.endswith(told)
        assert "step 7 (to t = 0.07)" in title
        assert ("Newton" if newton else "the velocity v is not finite") in title
        assert "every step" not in title
        assert (f"{np.prod(batch)} runs {batch}, each of" in title) == bool(batch)
    assert "every step finite" in repr(run(batch))


def test_a_batch_and_a_sweep_say_how_many():
    assert repr(run((2, 3))).startswith("Solution: 6 runs (2, 3), each of 501 saved times, t = 0 ... 5 s, dt = 0.01 s;")
    uneven = jnp.broadcast_to(jnp.linspace(0.01, 0.1, 4), (3, 4))  # `times=`: a step size for each interval
    assert "dt = 0.01 ... 0.1 s" in repr(run((3,), saved=5, dt=1.0)._replace(dt=uneven))
    assert repr(run((3,), failed=2).failure).startswith("Failure(1 of 3 runs failed, step=int32[3]")


@pytest.mark.parametrize(
    ("result", "text"),
    [
        (State(jnp.asarray(0.5), {"x": jnp.ones(2)}, jnp.ones(2), jnp.ones(2)), "State(t=0.5, q={x: float64[2]}, v="),
        (Info(jnp.ones(9), converged=jnp.arange(9) > 1), "Info(2 of 9 not converged, residual=float64[9], converged="),
        (Info(jnp.ones(9), converged=jnp.ones(9, bool)), "Info(all converged, residual=float64[9], converged=bool[9])"),
        (Info(jnp.asarray(1e-12), converged=jnp.asarray(True)), "Info(residual=1e-12, converged=True)"),
        (run(failed=3).failure, "Failure(the velocity v is not finite, step=3, newton=False, quantity=1)"),
        (run(failed=3, quantity=4).failure, "Failure(the internal state z is not finite, step=3"),
        (run(failed=3, newton=True).failure, "Failure(Newton did not converge, step=3, newton=True, quantity=1)"),
        (run(failed=3).failure._replace(row=jnp.asarray(2)), "Failure(a constraint depends on others, step=3, "),
        (
            run(failed=3).failure._replace(solve=jnp.asarray(0.1)),
            "Failure(the linear solve has too large a residual, step=3, ",
        ),
        (run().failure, "Failure(no step failed, step=0, newton=False, quantity=1)"),
        (Interpolant(jnp.ones((2, 1)), None), "Interpolant(q=float64[2,1])"),
        (
            ModeBias(*jnp.array([[10.0, 20], [0, 0.1], [0.1, 0.2], [0.01, 0.02], [0, 0.03]])),
            "ModeBias(2 modes, 10 ... 20 rad/s (1.59 ... 3.18 Hz), w h = 0.1 ... 0.2: stiffness off by 1 ... 2 %, ",
        ),
    ],
)
def test_small_results_take_one_line(result, text):
    assert repr(result).startswith(text)
    assert "\n" not in repr(result)
    jax.eval_shape(lambda x: repr(x) and x, result)  # and of tracers it fails no more


def test_a_fit_shows_estimates_with_errors():
    assert repr(fitted()).splitlines() == [
        "FitResult: converged: the cost changes by less than tolerance; 5 iterations, cost 0.25",
        "    parameter  estimate  standard error",
        "    c          0.5       0.1",
        "    k          2         undetermined",
    ]
    held = repr(fitted(code=LIMIT, transforms=(fixed, scaled), variance=(0.04,)))
    assert held.startswith("FitResult: stopped: max_iterations reached;")
    assert re.search(r"c +0\.5 +fixed\n +k +2 +0\.2$", held)
    assert "standard error" not in repr(fitted(uncertainty=None))
    many = repr(fitted({"x": jnp.ones(100)}, transforms=(scaled,), uncertainty=None)).splitlines()
    assert len(many) == 2 + MOST + 1
    assert many[-1].strip() == f"and {100 - MOST} more"


def test_a_batch_of_fits_says_how_many_converged():
    batch = jax.tree.map(lambda x: jnp.stack([x, x, x]), fitted()._replace(transforms=()))
    text = repr(batch._replace(code=jnp.array([COST, LIMIT, COST]), transforms=(scaled, scaled)))
    assert text.startswith("FitResult: 2 of 3 fits converged\n")
    assert re.search(r"params\.k +\(3,\) +float64$", text)


def test_tables_for_a_notebook_take_its_colours_and_escape_names():
    page = fitted({"<b>k": jnp.asarray(2.0), "c & d": jnp.asarray(0.5)})._repr_html_()
    assert "&lt;b&gt;k" in page
    assert "c &amp; d" in page
    assert "<b>" not in page
    assert "background" not in page
    assert not re.search(r"[^-]color:", page)
    rows = re.findall("<tr>", run()._repr_html_())
    assert len(rows) == 1 + 3
    assert "every step finite" in run()._repr_html_()


RESULTS = [run(), run((3,), failed=4), fitted(), State(0.0, *[jnp.full(3, VALUE)] * 3), run().failure]


@pytest.mark.parametrize("result", RESULTS, ids=lambda x: type(x).__name__)
def test_no_array_is_printed_and_nothing_computed(result):
    """Inside jit and vmap: neither of tracers, nor of known numbers while something is traced."""
    assert str(VALUE)[:5] not in repr(result)
    closed = repr(result)
    told = []
    arrays, rest = jax.tree.flatten(result)
    places = [isinstance(x, jax.Array) for x in arrays]

    def show(given):
        given = iter(given)
        leaves = [next(given) if here else x for x, here in zip(arrays, places, strict=True)]
        traced = jax.tree.unflatten(rest, leaves)
        told.append(repr(traced) + str(traced) + getattr(traced, "_repr_html_", str)())
        assert repr(result) == closed
        return leaves[0] if places[0] else jnp.zeros(())

    given = [x for x, here in zip(arrays, places, strict=True) if here]
    assert not jax.make_jaxpr(show)(given).eqns
    jax.make_jaxpr(jax.vmap(show))([jnp.stack([x, x]) for x in given])
    assert len(told) == 2
    assert all("every step" not in x and "converged:" not in x for x in told)


@pytest.mark.parametrize("result", RESULTS, ids=lambda x: type(x).__name__)
def test_whatever_jax_puts_in_is_shown(result):
    for other in (0, None, "x", object(), jnp.ones(()), jax.ShapeDtypeStruct((2,), np.float32), np.ones((2, 2, 2))):
        assert repr(jax.tree.map(lambda x, other=other: other, result))
        assert repr(type(result)(*[other] * len(result))) if not hasattr(result, "transforms") else True
    assert "501" in repr(run(failure=None))


def test_what_is_deleted_or_no_number_is_shown_by_its_shape():
    gone = jnp.ones(3)
    gone.delete()
    assert repr(Interpolant(gone, jax.random.key(0))) == "Interpolant(q=float64[3], v=key<fry>[])"


@pytest.mark.slow
def test_completion_shows_our_names():
    for result, ours in ((run(), {"t", "q", "check"}), (fitted(), {"params", "summary", "plot", "interval"})):
        names = {name for name in dir(result) if not name.startswith("_")}
        assert ours < names
        assert not {"count", "index"} & names
        assert result.count(None) >= 0  # it is a tuple all the same
    assert isinstance(run(), tuple)
    assert pickle.loads(pickle.dumps(State(1, 2, 3, 4))) == State(1, 2, 3, 4)
    assert run()._replace(t=1)[0] == 1
    assert State(1, 2, 3, 4) == (1, 2, 3, 4, *[None] * 8)
    assert jax.tree.leaves(State(1, 2, 3, 4)) == [1, 2, 3, 4]
    found = {x.name for x in jedi.Interpreter("run.", [{"run": run()}]).complete()}  # as in a kernel
    assert {"check", "q"} < found
    assert not {"count", "index"} & found


@pytest.mark.parametrize("room", [hhtjax, hhtjax.analysis, hhtjax.identification, hhtjax.rotation, hhtjax.trigonometry])
def test_a_package_completes_to_what_a_user_needs(room):
    assert dir(room) == sorted(room.__all__)


def test_every_result_with_arrays_is_shown():
    def public():
        for room in (hhtjax, hhtjax.analysis, hhtjax.identification):
            yield from (x for name, x in vars(room).items() if not name.startswith("_"))

    tuples = {x for x in public() if isinstance(x, type) and issubclass(x, tuple)}
    of_numbers = {"Choice", "Eigenvalue", "Explanation", "Gaussian", "Mode", "StepSize"}
    unseen = {x.__name__ for x in tuples if x.__dir__ is object.__dir__}
    assert unseen == of_numbers
    assert shown.__doc__


def test_an_exported_model_does_not_show_its_text():
    model = hhtjax.ExportedC("spring", "the header", "the source", (), (), (), (), (), {}, 9, 0)
    assert repr(model).startswith("ExportedC(name='spring', state=()")
    assert repr(hhtjax.ExportedFMU(model, "the description", "the wrapper")) == f"ExportedFMU(c={model!r})"


def test_a_line_of_progress_takes_the_place_of_the_one_before(capsys):
    overwrite("a longer one", last=False)
    overwrite("short", last=True)
    assert capsys.readouterr().err == f"\r{'a longer one':<79}\r{'short':<79}\n"
