"""The four-bar as an animation."""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.cardona_geradin1989.animation import save
from experiments.report import COLOURS
from hhtjax.plot import subplots

FRAMES = 56
TRAIL = 28  # frames


def four_bar(report: Any, path: dict) -> None:
    """Its links, straight lines between the pins beside them, and the way of the coupler's middle."""
    number, r, last = path["number"], path["r_m"], len(path["r_m"]) - 1
    shown = np.linspace(last * 0.2, last, FRAMES).round().astype(int)
    figure, axes = subplots(width=58, height=52)
    axes.set(xlim=(-0.35, 1.25), ylim=(-0.35, 1.0), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.plot([0, 1], [0, 0], "k^", ms=6)
    chords = [axes.plot([], [], color="0.75", lw=1)[0] for _ in range(3)]
    links = [axes.plot([], [], color=COLOURS[i], lw=2)[0] for i in range(3)]
    (trail,) = axes.plot([], [], color="0.6", lw=0.8)
    clock = axes.text(0.02, 0.95, "", transform=axes.transAxes)
    middle = (number + 1) + number // 2

    def draw(k: int) -> None:
        i = shown[k]
        for link in range(3):
            own = r[i, link * (number + 1) : (link + 1) * (number + 1)]
            links[link].set_data(*own.T)
            chords[link].set_data(*own[[0, -1]].T)
        trail.set_data(*r[shown[max(0, k - TRAIL)] : i + 1, middle].T)
        clock.set_text(f"{path['t_s'][i]:.2f} s, slowed down")

    save(report, "flexible_four_bar", figure, draw, FRAMES)
