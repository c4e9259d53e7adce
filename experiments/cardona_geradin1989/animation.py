"""Animations as GIF."""

from matplotlib.animation import FuncAnimation, PillowWriter


def save(report, name, figure, draw_frame, frames, frames_per_second=20):
    """NAME.gif of `frames` frames; draw_frame(i) draws the i-th on the figure."""
    path = report.out / f"{name}.gif"
    FuncAnimation(figure, draw_frame, frames=frames, init_func=lambda: None).save(path, PillowWriter(frames_per_second))
    report.written.append(path)
