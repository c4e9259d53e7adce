"""Films and pictures of scenes and mechanisms."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.ticker import FixedLocator, MaxNLocator

from hhtjax.bodies import Mechanism
from hhtjax.checks import require_function, require_number
from hhtjax.description import Real
from hhtjax.plot.styles import COLOURS, canvas, legend, look, require_run, with_unit
from hhtjax.runs.interpolate import interpolate
from hhtjax.scenes import EventScene, InternalScene, Scene
from hhtjax.scenes.drawings import Shape

if TYPE_CHECKING:
    from hhtjax.runs.solution import Solution


def animation(
    solution: Any,
    points: Any,
    *,
    fps: float = 25,
    speed: float = 1.0,
    trace: Any = None,
    unit: str | None = "m",
    ax: Any = None,
) -> Film:
    """Makes a film of a run: of a scene, a mechanism, or polylines through moving points, in the plane or in space.

    Frames are equally spaced in time for any step size. They are interpolated between the steps.

    Args:
        solution: solution of one run.
        points: what is drawn. A scene of `hhtjax.scenes` that has a `drawing`; or a `hhtjax.bodies.Mechanism`, whose
            bodies are drawn as bars; or a function `points(q)`. It returns the corners of a polyline, (k, 2) or (k, 3),
            or a list or tuple of polylines and of shapes of `hhtjax.scenes.drawings`.
        fps: frames per second of film.
        speed: time of the run for each second of film.
        trace: index of a point of the first polyline whose path is drawn, or several indices.
        unit: unit of length.
        ax: axes to draw into, for points in space with projection="3d"; None for a new figure.

    Returns:
        A `Film`, a `FuncAnimation` of matplotlib. `.save("film.gif")` writes a file; as the last line of a notebook
        cell it plays. Keep it in a variable until then, because matplotlib loses an animation without a reference.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; points of a wrong shape; a scene without a drawing.

    >>> import pathlib, tempfile, jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> scene = hhtjax.scenes.duffing.hardening_spring()
    >>> run = hhtjax.simulate(
    ...     scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=1e-3, num_steps=100)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     hhtjax.plot.animation(run, scene, fps=20, speed=0.5).save(pathlib.Path(folder) / "spring.gif")
    ...     [path.name for path in pathlib.Path(folder).iterdir()]
    ['spring.gif']
    >>> film = hhtjax.plot.animation(run, lambda q: jnp.array([[0.0, 0.0], [q[0], 0.0]]), fps=20, trace=1)
    >>> len(film.to_jshtml()) > 10_000
    True
    >>> plt.close("all")
    """
    require_number("animation", "fps", fps, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_number("animation", "speed", speed, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_run("animation", solution)
    start, end = (float(x) for x in np.asarray(solution.t)[[0, -1]])
    times = start + np.arange(int((end - start) / speed * fps + 1e-9) + 1) / fps * speed
    frames = _frames("animation", solution, points, np.minimum(times, end))
    traced = [] if trace is None else [int(i) for i in np.ravel(trace)]
    most = len(frames[0][0].points)
    if any(not -most <= i < most for i in traced):
        raise ValueError(f"animation: `trace` must number points of the first polyline, {most}; received {trace!r}.")
    with _scene("animation", ax, frames, unit) as panel:
        bars = [panel.plot(*x.points.T, **_look(i, x.kind))[0] for i, x in enumerate(frames[0])]
        paths = [panel.plot(*frames[0][0].points[[i]].T, color=COLOURS[1], lw=0.8)[0] for i in traced]
        told = max(0, 2 - int(np.floor(np.log10(max(end - start, 1e-9)))))  # decimals: two for a run of 1 s
        title = panel.set_title(f"t = {times[0]:.{told}f} s")

    def draw(k: int):
        for line, x in zip(bars, frames[k], strict=True):
            _move(line, x.points)
        for line, i in zip(paths, traced, strict=True):
            _move(line, np.stack([frame[0].points[i] for frame in frames[: k + 1]]))
        title.set_text(f"t = {times[k]:.{told}f} s")
        return [*bars, *paths, title]

    return Film(panel.figure, draw, frames=len(frames), interval=1e3 / fps, blit=False)


class Film(FuncAnimation):
    """An animation that plays in a notebook, and whose GIF needs no other program; made by `animation`."""

    def save(self, filename: Any, writer: Any = None, **options: Any):
        """Writes a file, like `Animation.save` of matplotlib. Without `writer` Pillow writes a .gif."""
        super().save(filename, "pillow" if writer is None and Path(filename).suffix == ".gif" else writer, **options)

    def _repr_html_(self) -> str:
        """The film with buttons. The figure is closed, because a notebook would show it again below the film."""
        shown, film = self.to_jshtml(), cast(Any, self)  # matplotlib's types do not have its figure
        plt.close(film._fig)
        return shown


def configuration(solution: Any, points: Any, times: Any, *, unit: str | None = "m", ax: Any = None) -> Any:
    """Draws a scene or a mechanism at some times. Earlier positions are paler.

    Args:
        solution, points, unit, ax: as in `animation`.
        times: a time within the run, or a vector of times; positions between the steps are interpolated.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; points of a wrong shape; times outside the run.

    >>> import jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -4.0 * q)
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
    >>> ax = hhtjax.plot.configuration(run, lambda q: jnp.array([[0.0, 0.0], [q[0], 0.0]]), [0.0, 1.0])
    >>> ax.lines[1].get_xdata().round(3).tolist(), ax.get_ylabel()
    ([0.0, -0.409], 'y (m)')
    >>> plt.close(ax.figure)
    """
    require_run("configuration", solution)
    times = np.atleast_1d(np.asarray(times, float))
    frames = _frames("configuration", solution, points, times)
    with _scene("configuration", ax, frames, unit) as panel:
        for k, (t, frame) in enumerate(zip(times, frames, strict=True)):
            for i, x in enumerate(frame):
                shown = {"alpha": 1 - 0.75 * (len(frames) - 1 - k) / max(1, len(frames) - 1)}
                panel.plot(*x.points.T, **_look(i, x.kind), **shown, label=f"t = {t:.3g} s" if i == 0 else None)
        legend(panel)
    return panel


def _frames(caller: str, solution: Solution, points: Any, times: np.ndarray) -> list[list[Shape]]:
    """The shapes at each time; all are in the plane, or all in space."""
    shapes = _shapes(caller, points)
    q = interpolate(solution, times).q
    frames = []
    for k, t in enumerate(times):
        found = shapes(jax.tree.map(lambda x, k=k: x[k], q), float(t))
        found = [found] if not isinstance(found, (list, tuple)) or isinstance(found, Shape) else found
        frames.append([_as_shape(x) for x in found])
    sizes = [x.points.shape for x in frames[0]]
    if not sizes or any(len(s) != 2 or s[1] not in (2, 3) or s[1] != sizes[0][1] for s in sizes):
        raise ValueError(f"{caller}: `points` must return (k, 2) or (k, 3), or a list of these; received {sizes}.")
    return frames


def _shapes(caller: str, points: Any) -> Callable:
    """The function of q and t that returns the shapes."""
    if isinstance(points, (Scene, EventScene, InternalScene)):
        drawing, params = points.drawing, points.params
        if drawing is None:
            raise ValueError(f"{caller}: `points` is a {type(points).__name__} without a `drawing`: give it one.")
        return lambda q, t: drawing(q, t, params)
    points = points.bars() if isinstance(points, Mechanism) else points
    require_function(caller, "points", points, "points(q)")
    return lambda q, t: points(q)


def _as_shape(x: Any) -> Shape:
    """A shape. Points without a kind become a polyline with a colour of its own."""
    return Shape(np.asarray(x.points, float), x.kind) if isinstance(x, Shape) else Shape(np.asarray(x, float), "")


@contextmanager
def _scene(caller: str, ax, frames: list, unit: str | None):
    """Axes in the plane or in space. Their limits contain all frames, and all directions have the same scale."""
    spatial = frames[0][0].points.shape[1] == 3
    if ax is not None and spatial != hasattr(ax, "get_zlim"):
        wanted = 'projection="3d"' if spatial else "two dimensions"
        raise TypeError(f"{caller}: `ax` must be axes with {wanted}, as the points have; received {ax!r}.")
    corners = np.concatenate([x.points for frame in frames for x in frame])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.06 * max(np.max(high - low), 1e-12)
    size = high - low + 2 * margin
    options = {"height": 75, "subplot_kw": {"projection": "3d"}} if spatial else {"height": _height(*size)}
    with canvas(caller, ax, **options) as (panel,):
        for name, limits in zip("xyz", zip(low - margin, high + margin, strict=True), strict=False):
            panel.set(**{f"{name}lim": limits, f"{name}label": with_unit(name, unit)})
        if spatial:
            panel.set_box_aspect(size, zoom=0.8)
            axes, middles = (panel.xaxis, panel.yaxis, panel.zaxis), ((low + high) / 2).round(2) + 0.0
            for axis, middle, length in zip(axes, middles, size / max(size), strict=True):
                one = length <= 0.2  # two labels would overlap
                axis.set_major_locator(FixedLocator([middle]) if one else MaxNLocator(1 + int(5 * length)))
        else:
            panel.set_aspect("equal")
            if size[0] < 0.8 * size[1]:  # narrow: more labels would overlap
                panel.xaxis.set_major_locator(MaxNLocator(2))
        yield panel


def _height(width: Real, height: Real) -> Real:
    """Height in mm of a figure 85 mm wide, for a scene of this width and height; 25 mm are for title and labels."""
    return min(max(25 + 65 * height / width, 40), 150)


LOOKS: dict[str, dict] = {  # line properties for each kind of shape
    "bar": {"color": COLOURS[0], "marker": "o", "ms": 3.5, "lw": 1.6},
    "body": {"color": COLOURS[1], "lw": 1.4},
    "spring": {"color": COLOURS[2], "lw": 1.0},
    "arrow": {"color": COLOURS[3], "lw": 1.2},
    "ground": {"color": "#777777", "lw": 0.8, "zorder": 1.5},
    "aim": {"color": "#777777", "lw": 1.0, "ls": "--", "zorder": 1.5},
}


def _look(i: int, kind: str) -> dict:
    """Line properties of a kind of shape, or of polyline number i."""
    return LOOKS[kind] if kind else look(i, marker=True) | {"ls": "-", "lw": 1.6, "ms": 3.5}


def _move(line, x: np.ndarray):
    """Moves a line to new points."""
    if x.shape[1] == 3:
        line.set_data_3d(*x.T)
    else:
        line.set_data(*x.T)
