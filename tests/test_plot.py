"""Charts: what is drawn, how it is labelled, how large its text is, and what happens without matplotlib."""

import subprocess
import sys

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import plotted_runs
import pytest

import hhtjax
from hhtjax import plot

mpl.use("Agg")
import matplotlib.pyplot as plt

SMALLEST, LARGEST = 7.0, 9.0  # pt


PENDULUM = hhtjax.System(
    jnp.ones(2),
    lambda q, v, t, params: jnp.array([0.0, -9.81]),
    lambda q, t, params: jnp.array([jnp.sum(q**2) - 1.0]),
)


@pytest.fixture(autouse=True)
def closed():
    """No test leaves a figure behind, or a setting changed."""
    before = dict(mpl.rcParams)
    yield
    plt.close("all")
    assert dict(mpl.rcParams) == before


@pytest.fixture
def run():
    return plotted_runs.run()


@pytest.fixture
def sweep():
    return plotted_runs.sweep()


@pytest.fixture(scope="module")
def swing():
    q0 = jnp.array([1.0, 0.0])
    return hhtjax.simulate(PENDULUM, hhtjax.hht(), q0, jnp.zeros(2), dt=0.02, num_steps=20)


def sizes(figure):
    """Of all text that a figure shows, in pt; after drawing, when ticks get their labels, where other sizes hold."""
    with mpl.rc_context({"font.size": 12, "xtick.labelsize": 12, "ytick.labelsize": 12}):
        figure.canvas.draw()
    texts = figure.findobj(mpl.text.Text)
    return {text.get_text(): text.get_fontsize() for text in texts if text.get_text().strip() and text.get_visible()}


def labels(ax):
    return [line.get_label() for line in ax.lines if not line.get_label().startswith("_")]


def test_trajectory_names_entries_and_units(run):
    upper, lower = plot.trajectory(run, ("q", "v"), units={"q": {"phi": "rad", "x": "m"}, "v": "1/s"})
    assert labels(upper) == ["phi (rad)", "x (m)"]
    assert labels(lower) == ["phi", "x"]
    assert (upper.get_ylabel(), lower.get_ylabel(), lower.get_xlabel()) == ("q", "v (1/s)", "t (s)")
    np.testing.assert_array_equal(upper.lines[1].get_ydata(), run.q["x"])
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), run.v["phi"])
    np.testing.assert_array_equal(lower.lines[0].get_xdata(), run.t)
    looks = {(line.get_color(), line.get_linestyle()) for line in upper.lines}
    assert len(looks) == 2
    assert len({style for _, style in looks}) == 2


@pytest.mark.slow
def test_trajectory_marks_events():
    """At their times, those that were met alone, over the whole height, and without a place in the legend."""
    scene = hhtjax.scenes.balls.bouncing(drag=0.0)
    options = {"dt": 0.05, "num_steps": 20, "events": scene.events, "keep_events": 4}
    run = hhtjax.simulate(scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, **options)
    ax = plot.trajectory(run, "v", units="m/s")
    (marks,) = ax.collections
    (segment,) = marks.get_segments()
    np.testing.assert_allclose(segment, [[np.sqrt(2 / 9.81), 0], [np.sqrt(2 / 9.81), 1]], rtol=1e-6)
    assert ax.get_ylim()[0] < -4  # not from 0 to 1
    assert labels(ax) == ["v[0]"]
    plain = plot.trajectory(run._replace(events=None), "v", units="m/s")
    assert not plain.collections
    np.testing.assert_allclose(ax.get_ylim(), plain.get_ylim())


@pytest.mark.slow
def test_trajectory_draws_into_axes_given_run_after_run(run, swing):
    figure, ax = plt.subplots()
    assert plot.trajectory(run, "acceleration", entries="phi", units="rad/s^2", label="one", ax=ax) is ax
    plot.trajectory(run, "acceleration", entries="phi", units="rad/s^2", label="two", ax=ax, lw=3)
    assert ax.figure is figure
    assert labels(ax) == ["one", "two"]
    assert ax.lines[0].get_color() != ax.lines[1].get_color()
    assert ax.lines[1].get_linewidth() == 3
    assert len(ax.get_legend().get_texts()) == 2
    assert plot.trajectory(run, label="one", key=False).get_legend() is None
    assert ax.get_ylabel() == "phi (rad/s^2)"
    multipliers = plot.trajectory(swing, "multipliers", units="N")
    assert labels(multipliers) == ["L[0]"]
    np.testing.assert_array_equal(multipliers.lines[0].get_ydata(), swing.multipliers[:, 0])
    assert labels(plot.trajectory(swing, units={"[0]": "m", "[1]": "mm"})) == ["q[0] (m)", "q[1] (mm)"]
    internal = plot.trajectory(run._replace(z={"current": run.q["x"]}), "z", units="A")
    assert internal.get_ylabel() == "current (A)"
    np.testing.assert_array_equal(internal.lines[0].get_ydata(), run.q["x"])


def test_phase_plane(run):
    ax = plot.phase_plane(run, "phi", units=("rad", "rad/s"))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("phi (rad)", "dphi/dt (rad/s)")
    np.testing.assert_array_equal(ax.lines[0].get_xdata(), run.q["phi"])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), run.v["phi"])


@pytest.mark.slow
def test_energy_balance_finds_the_potential_of_a_lagrangian():
    def lagrangian(q, v, t, p):
        return 0.5 * jnp.sum(v**2) - 0.5 * p["k"] * jnp.sum(q**2)

    system = hhtjax.System.from_lagrangian(lagrangian)
    run = hhtjax.simulate(system, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), plotted_runs.PARAMS, dt=0.1, num_steps=20)
    upper, lower = plot.energy_balance(system, run, plotted_runs.PARAMS)
    curves = {line.get_label(): line.get_ydata() for line in upper.lines}
    np.testing.assert_allclose(curves["potential"], 2.0 * run.q[:, 0] ** 2)
    np.testing.assert_allclose(curves["kinetic + potential"] - 2.0, lower.lines[0].get_ydata(), atol=1e-12)
    assert upper.get_ylabel() == "energy (J)"
    one, two = plot.energy_balance(
        system, run, plotted_runs.PARAMS, energy=lambda q, v, t, p: lagrangian(q, v, t, {"k": -p["k"]})
    )
    np.testing.assert_allclose(one.lines[0].get_ydata(), curves["kinetic + potential"])
    np.testing.assert_allclose(two.lines[0].get_ydata(), lower.lines[0].get_ydata(), atol=1e-12)
    balance = hhtjax.analysis.energy_balance(system, run, plotted_runs.PARAMS)
    assert labels(plot.energy_balance(balance)[0]) == ["kinetic", "work of all forces"]


@pytest.mark.slow
def test_constraint_drift(swing):
    ax = plot.constraint_drift(swing, unit="m")
    assert labels(ax) == ["|Phi| (m)", "|dPhi/dt| (m/s)"]
    assert ax.get_yscale() == "log"
    shown = ax.lines[0].get_ydata()
    drift = np.asarray(swing.info.constraint)
    np.testing.assert_array_equal(shown[drift > 0], drift[drift > 0])
    assert np.isnan(shown[drift == 0]).all()


def test_error_against_h_of_a_sweep_has_the_order_of_the_method(sweep):
    ax = plot.error_against_h(sweep, label="hht", unit="rad")
    (line,) = [line for line in ax.lines if not line.get_label().startswith("_")]
    h, error = line.get_data()
    finest = {name: q[0] for name, q in sweep.q.items()}
    expected = [np.sqrt(np.mean([(q[i] - finest[n]) ** 2 for n, q in sweep.q.items()])) for i in range(1, 6)]
    np.testing.assert_allclose(error, expected)
    np.testing.assert_allclose(h, sweep.dt[1:])
    name, order = line.get_label().split(": order ")
    assert name == "hht"
    assert abs(float(order) - 2) < 0.15
    triangles = [line for line in ax.lines if line.get_label() == "_slope"]
    (x0, y0), (x1, y1) = (triangles[0].get_xydata()[i] for i in (0, 2))
    np.testing.assert_allclose(np.log(y1 / y0) / np.log(x1 / x0), 2)
    assert "2" in [text.get_text() for text in ax.texts]


def test_error_against_h_of_several_curves():
    h = np.logspace(-3, -1, 5)
    found = hhtjax.analysis.ObservedOrder(h, h**4, None)
    rounded = np.array([np.nan, 0.0, 1e-2, 4e-2, 1.0])
    ax = plot.error_against_h({"a": (h, 5 * h), "b": found, "c": (h[::-1], rounded[::-1])}, slopes=(1, 4))
    slopes = np.log([4.0, 25.0]) / np.log(10) * 2
    assert labels(ax) == ["a: order 1.00", "b: order 4.00", f"c: order {slopes[0]:.1f} to {slopes[1]:.1f}"]
    assert len(ax.lines[2].get_xdata()) == 3
    assert [text.get_text() for text in ax.texts] == ["1", "4"]
    assert len({line.get_marker() for line in ax.lines[:3]}) == 3
    assert len(ax.get_legend().get_texts()) == 3


def test_curves_can_look_otherwise_and_share_a_legend():
    h = np.array([0.1, 0.2])
    ax = plot.error_against_h({"a": (h, h), "b": (h, h**2)}, lines={"b": {"marker": "x", "ls": ":"}}, key=False)
    assert labels(ax) == ["a", "b"]
    assert ax.get_legend() is None
    assert [line.get_marker() for line in ax.lines[:2]] == ["o", "x"]
    ax = plot.work_precision({"a": (h, h), "b": (h, h**2)}, lines={"a": {"color": "red"}}, key=False)
    assert (labels(ax), ax.get_legend()) == (["a", "b"], None)
    assert [line.get_color() for line in ax.lines] == ["red", plot.COLOURS[1]]


def test_work_precision():
    curves = {"ours": ([1.0, 2.0, np.nan], [1e-2, 1e-3, 1.0]), "peer": ([3.0, 4.0], [0.0, 1e-3])}
    ax = plot.work_precision(curves, ours=("ours",), xlabel="time (ms)", ylabel="error (m)")
    assert ax.lines[0].get_xdata().tolist() == [1.0, 2.0]
    assert ax.lines[1].get_xdata().tolist() == [4.0]
    assert ax.lines[0].get_linewidth() > ax.lines[1].get_linewidth()
    assert (ax.get_xscale(), ax.get_yscale(), ax.get_xlabel()) == ("log", "log", "time (ms)")


@pytest.mark.slow
def test_curves_over_frequency_are_those_of_analysis():
    frequency = np.array([0.1, 1.0, 3.0])
    stepper = hhtjax.hht(alpha=-0.1)
    for name in ("spectral_radius", "damping_ratio", "period_elongation"):
        ax = getattr(plot, name)({"hht": stepper}, frequency=frequency)
        expected = getattr(hhtjax.analysis, name)(stepper, frequency)
        np.testing.assert_array_equal(ax.lines[0].get_ydata(), expected)
        assert ax.get_xlabel() == "w h (rad)"
        assert labels(ax) == ["hht"]


def test_stability_region():
    ax = plot.stability_region({"rk4": hhtjax.rk4()}, real=(-4, 2), imag=(-4, 4), points=25)
    edge = np.concatenate([path.vertices for path in ax.collections[1].get_paths()])
    on_the_axis = edge[abs(edge[:, 1]) < 1e-9, 0]
    assert abs(on_the_axis.min() + 2.785) < 0.05  # the real interval of RK4
    assert ax.get_legend().get_texts()[0].get_text() == "rk4"


@pytest.mark.slow
def test_animation_moves_in_the_plane_and_in_space(swing, tmp_path):
    film = plot.animation(swing, lambda q: jnp.stack([jnp.zeros(2), q]), fps=10, trace=1)
    film.save(tmp_path / "film.gif", writer="pillow")
    assert (tmp_path / "film.gif").stat().st_size > 1000
    (ax,) = film._fig.axes
    np.testing.assert_allclose(ax.lines[0].get_xydata()[1], swing.q[-1], atol=1e-12)
    np.testing.assert_allclose(ax.lines[1].get_xydata(), swing.q[::5], atol=1e-12)
    assert ax.get_xlabel() == "x (m)"
    bars = plot.configuration(swing, lambda q: [np.array([[0.0, 0.0, 0.0], [q[0], 0.0, q[1]]])], [0.0, 0.4])
    assert bars.get_zlabel() == "z (m)"
    assert labels(bars) == ["t = 0 s", "t = 0.4 s"]


@pytest.mark.slow
def test_text_is_legible_and_files_are_written_without_a_warning(run, sweep, tmp_path):
    result = plotted_runs.fit()
    t = np.arange(64.0)
    figures = {
        "trajectory": plot.trajectory(run, ("q", "v", "acceleration"))[0],
        "order": plot.error_against_h(sweep, label="hht"),
        "fit": plot.fit_against_data(t, np.sin(t), np.cos(t))[0],
        "estimates": plot.estimates(result),
        "correlations": plot.correlations(result),
    }
    for name, ax in figures.items():
        figure = ax.figure
        assert abs(25.4 * figure.get_size_inches()[0] - 85) < 1e-9
        outside = {text: size for text, size in sizes(figure).items() if not SMALLEST <= size <= LARGEST}
        assert not outside, (name, outside)
    paths = plot.save(figures["order"].figure, tmp_path / "order", ("png", "pdf", "svg"))
    assert [path.name for path in paths] == ["order.png", "order.pdf", "order.svg"]
    assert paths[0].read_bytes()[:4] == b"\x89PNG"
    assert b"/Type /Font" in paths[1].read_bytes()
    assert "step size h (s)</text>" in paths[2].read_text()


def test_legends_stand_above_the_curves(run):
    ax = plot.trajectory(run, "q")
    ax.figure.canvas.draw()
    legend = ax.get_legend().get_window_extent()
    assert legend.y0 >= ax.get_window_extent().y1
    assert legend.x1 <= ax.figure.bbox.x1


@pytest.mark.slow
def test_the_library_works_without_matplotlib():
    """`import hhtjax` takes what every user needs; where there is no matplotlib, charts say what to install."""
    program = """
import sys
import hhtjax
assert {"matplotlib", "optax", "scipy", "equinox"}.isdisjoint(sys.modules)
sys.modules["matplotlib"] = None
try:
    hhtjax.plot
except ImportError as error:
    assert "pip install 'hhtjax[plot]'" in str(error), error
else:
    raise AssertionError("no error")
assert not hasattr(hhtjax, "chart")
del sys.modules["matplotlib"]
assert hhtjax.plot.trajectory.__doc__
"""
    subprocess.run([sys.executable, "-c", program], check=True)
