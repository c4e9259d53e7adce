"""Every scene can be drawn: at its start, as a film in one call, and as a part of what goes into `jax.jit`."""

import inspect
from types import ModuleType

import jax
import matplotlib as mpl
import numpy as np
import pytest

import hhtjax
from hhtjax import plot, scenes
from hhtjax.plot.mechanisms import LOOKS
from hhtjax.scenes import EventScene, InternalScene, Scene, bouc_wen, double_pendulum, drawings, duffing

mpl.use("Agg")
import matplotlib.pyplot as plt

GIVEN = {  # the input of a record is not drawn
    "duffing.measured": ({"m": 1.0}, None, 0.1, 0.0, 1.0),
    "bouc_wen.measured": (bouc_wen.BENCHMARK, None, 1.0),
}
FUNCTIONS = {
    f"{name}.{inner}": function
    for name, module in vars(scenes).items()
    if isinstance(module, ModuleType)
    for inner, function in vars(module).items()
    if inspect.isfunction(function)
    and inspect.signature(function).return_annotation in ("Scene", "EventScene", "InternalScene")
    and not inner.startswith("_")
}


def test_all_scenes_are_found():
    modules = [name for name, x in vars(scenes).items() if isinstance(x, ModuleType)]
    assert {name.partition(".")[0] for name in FUNCTIONS} == set(modules) - {"scene", "drawings"}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_scene_is_drawn_by_shapes_that_move_with_it(name):
    scene = FUNCTIONS[name](*GIVEN.get(name, ()))
    assert isinstance(scene, (Scene, EventScene, InternalScene))
    assert not any(callable(x) for x in jax.tree.leaves(scene.drawing))  # it can go into jit
    q = jax.tree.map(np.asarray, scene.q0)
    shapes = scene.drawing(q, 0.0, scene.params)
    dimensions = {shape.points.shape[1] for shape in shapes}
    assert dimensions in ({2}, {3})
    assert all(np.isfinite(shape.points).all() and shape.kind in LOOKS for shape in shapes)
    turn = np.diag([-1.0, -1.0, 1.0])
    moved = jax.tree.map(lambda x: turn @ x if x.shape[-2:] == (3, 3) else x + 0.3, q)
    pairs = zip(shapes, scene.drawing(moved, 0.0, scene.params), strict=True)
    assert max(np.abs(before.points - after.points).max() for before, after in pairs) > 0.01


def test_a_spring_keeps_its_ends_and_its_width():
    for first, second in (((0.0, 0.0), (0.0, 2.0)), ((0.0, 0.0, 0.0), (1.0, 0.0, 2.0))):
        points = drawings.spring(first, second, width=0.2).points
        np.testing.assert_array_equal(points[[0, -1]], [first, second])
        way = np.asarray(second) / np.linalg.norm(second)
        away = points - np.outer(points @ way, way)
        assert abs(np.linalg.norm(away, axis=1).max() - 0.1) < 1e-12


def test_ground_is_solid_on_the_right_of_the_way():
    points = drawings.ground((0.0, 0.0), (1.0, 0.0), depth=0.1).points
    assert points[:, 1].min() == -0.1
    assert points[:, 1].max() == 0.0
    moved = drawings.ground((0.0, 0.0), (1.0, 0.0), depth=0.1, shift=0.75).points
    np.testing.assert_allclose((moved - points)[1:-1], np.tile([0.25 / 8, 0.0], (24, 1)), atol=1e-12)


def film_of(scene, move):
    """A film of five saved times that nothing was run for: q0 and what `move` makes of it in 0.4 s."""
    t = np.linspace(0, 0.4, 5)
    q = np.stack([move(np.asarray(scene.q0), x) for x in t])
    nothing = np.zeros((5, *np.shape(scene.v0)))
    run = hhtjax.Solution(t, q, nothing, nothing, None, np.asarray(0.1), None, None)
    return plot.animation(run, scene, fps=10)


@pytest.mark.slow
def test_a_film_is_one_call(tmp_path):
    film = film_of(duffing.driven(), lambda q, t: q + t)
    film.save(tmp_path / "duffing.gif")
    html = film._repr_html_()
    assert (tmp_path / "duffing.gif").read_bytes()[:3] == b"GIF"
    assert "data:image/png;base64" in html
    assert not plt.get_fignums()  # a notebook shows the film, and not the figure once more
    (ax,) = film._fig.axes
    assert ax.get_title() == "t = 0.400 s"
    np.testing.assert_allclose(ax.lines[0].get_xdata().mean(), 0.5 + 0.4 - 0.6 / 10, atol=1e-9)


def test_a_scene_without_a_drawing_is_named():
    scene = Scene(*double_pendulum.free())
    with pytest.raises(ValueError, match="animation: `points` is a Scene without a `drawing`"):
        film_of(scene, lambda q, t: q)
