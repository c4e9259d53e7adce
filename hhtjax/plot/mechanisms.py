"""Pictures of mechanisms, moving and still, from the points of their bars."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.ticker import MaxNLocator

from hhtjax.bodies import Mechanism
from hhtjax.checks import require_function, require_number
from hhtjax.description import Real
from hhtjax.plot.styles import COLOURS, canvas, legend, look, require_run, with_unit
from hhtjax.runs.interpolate import interpolate

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
) -> FuncAnimation:
    """A film of a run: polylines through points that move, in the plane or in space.

    Frames are taken from dense output, at equal times, whatever the step size.

    Args:
        solution: of one run.
        points: `points(q)` -> (k, 2) or (k, 3), the corners of a polyline; or a list or tuple of these. Or a
            `hhtjax.bodies.Mechanism`, whose bodies are drawn as bars.
        fps: frames per second of film.
        speed: time of the run for each second of film.
        trace: number of a point of the first polyline whose path is drawn, or several.
        unit: of length.
        ax: axes to draw into, for points in space with projection="3d"; None for a figure of its own.

    Returns:
        A `FuncAnimation`: `.save("film.gif", writer="pillow")`, or `.to_jshtml()` in a notebook. Keep it, as matplotlib
        forgets what nobody holds.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; points of another shape.

    >>> import pathlib, tempfile, jax.numpy as jnp, matplotlib.pyplot as plt, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -4.0 * q)
    >>> run = hhtjax.simulate(spring, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), dt=0.1, num_steps=10)
    >>> figure, ax = hhtjax.plot.subplots()
    >>> film = hhtjax.plot.animation(run, lambda q: jnp.array([[0.0, 0.0], [q[0], 0.0]]), fps=2, trace=1, ax=ax)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     film.save(pathlib.Path(folder) / "spring.gif", writer="pillow")
    ...     [path.name for path in pathlib.Path(folder).iterdir()]
    ['spring.gif']
    >>> ax.get_title(), ax.lines[1].get_xdata().round(2).tolist()                        # the trace in the last frame
    ('t = 1.00', [1.0, 0.54, -0.41])
    >>> plt.close(figure)
    """
    require_number("animation", "fps", fps, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_number("animation", "speed", speed, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_run("animation", solution)
    start, end = (float(x) for x in np.asarray(solution.t)[[0, -1]])
    times = start + np.arange(int((end - start) / speed * fps + 1e-9) + 1) / fps * speed
    frames = _frames("animation", solution, points, np.minimum(times, end))
    traced = [] if trace is None else [int(i) for i in np.ravel(trace)]
    if any(not -len(frames[0][0]) <= i < len(frames[0][0]) for i in traced):
        raise ValueError(
            f"animation: `trace` must number points of the first polyline, {len(frames[0][0])}; received {trace!r}."
        )
    with _scene("animation", ax, frames, unit) as panel:
        bars = [panel.plot(*x.T, **_bar(i))[0] for i, x in enumerate(frames[0])]
        paths = [panel.plot(*frames[0][0][[i]].T, color=COLOURS[1], lw=0.8)[0] for i in traced]
        title = panel.set_title(f"t = {times[0]:.2f}")

    def draw(k: int):
        for line, x in zip(bars, frames[k], strict=True):
            _move(line, x)
        for line, i in zip(paths, traced, strict=True):
            _move(line, np.stack([frame[0][i] for frame in frames[: k + 1]]))
        title.set_text(f"t = {times[k]:.2f}")
        return [*bars, *paths, title]

    return FuncAnimation(panel.figure, draw, frames=len(frames), interval=1e3 / fps, blit=False)


def configuration(solution: Any, points: Any, times: Any, *, unit: str | None = "m", ax: Any = None) -> Any:
    """A mechanism at some times, the earlier the paler.

    Args:
        solution, points, unit, ax: as in `animation`.
        times: inside the run, one or a vector; dense output is between the steps.

    Returns:
        The axes.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; points of another shape; times outside the run.

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
                panel.plot(*x.T, **_bar(i), **shown, label=f"t = {t:.3g}" if i == 0 else None)
        legend(panel)
    return panel


def _frames(caller: str, solution: Solution, points: Callable, times: np.ndarray):
    """For each time a list of polylines, all of one dimension."""
    points = points.bars() if isinstance(points, Mechanism) else points
    require_function(caller, "points", points, "points(q)")
    q = interpolate(solution, times).q
    frames = []
    for k in range(len(times)):
        found = points(jax.tree.map(lambda x, k=k: x[k], q))
        frames.append([np.asarray(x, float) for x in (found if isinstance(found, (list, tuple)) else [found])])
    shapes = [x.shape for x in frames[0]]
    if not shapes or any(len(s) != 2 or s[1] not in (2, 3) or s[1] != shapes[0][1] for s in shapes):
        raise ValueError(f"{caller}: `points` must return (k, 2) or (k, 3), or a list of these; received {shapes}.")
    return frames


@contextmanager
def _scene(caller: str, ax, frames: list, unit: str | None):
    """Axes of the right dimension, with limits that hold all frames and the same scale in every direction."""
    spatial = frames[0][0].shape[1] == 3
    if ax is not None and spatial != hasattr(ax, "get_zlim"):
        wanted = 'projection="3d"' if spatial else "two dimensions"
        raise TypeError(f"{caller}: `ax` must be axes with {wanted}, as the points have; received {ax!r}.")
    corners = np.concatenate([x for frame in frames for x in frame])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.06 * max(np.max(high - low), 1e-12)
    size = high - low + 2 * margin
    options = {"height": 75, "subplot_kw": {"projection": "3d"}} if spatial else {"height": _height(*size)}
    with canvas(caller, ax, **options) as (panel,):
        for name, limits in zip("xyz", zip(low - margin, high + margin, strict=True), strict=False):
            panel.set(**{f"{name}lim": limits, f"{name}label": with_unit(name, unit)})
        if spatial:
            panel.set_box_aspect(size, zoom=0.8)
            for axis, length in zip((panel.xaxis, panel.yaxis, panel.zaxis), size / max(size), strict=True):
                axis.set_major_locator(MaxNLocator(1 + int(5 * length)))
        else:
            panel.set_aspect("equal")
        yield panel


def _height(width: Real, height: Real) -> Real:
    """Of a figure, in mm, 85 wide, for a scene of this width and height; 25 for title and labels."""
    return min(max(25 + 65 * height / width, 40), 150)


def _bar(i: int):
    return look(i, marker=True) | {"ls": "-", "lw": 1.6, "ms": 3.5}


def _move(line, x: np.ndarray):
    """A line through other points."""
    if x.shape[1] == 3:
        line.set_data_3d(*x.T)
    else:
        line.set_data(*x.T)
