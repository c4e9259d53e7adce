"""paper.md beside this file, made from page.md and the numbers of the other folders, so that none is copied by hand.

`python -m experiments.paper.page`
"""

import json
import math
from pathlib import Path

from experiments.kim2019.page import overview
from experiments.page import find
from experiments.work_precision.page import PACKAGES, best

HERE = Path(__file__).parent


def numbers_of(folder, name=None):
    """The committed numbers of an experiment."""
    return json.loads((HERE.parent / folder / f"{name or folder}.json").read_text())


def page():
    """The text of paper.md."""
    kim, benchmarks = numbers_of("kim2019"), numbers_of("benchmarks")
    single = {"method": "non-iterative, predictor", "saved": "end"}
    gradient = find(benchmarks["gradients"]["long"], steps=100_000, saved="path")
    times = numbers_of("work_precision")["times"]

    def fastest(scene, level, packages):
        return best(times[scene], level, packages)[0] or math.nan

    ratios = [fastest(scene, "1e-08", PACKAGES[:1]) / fastest(scene, "1e-08", PACKAGES[1:]) for scene in times]
    lost = [ratio for ratio in ratios if ratio > 1]
    orders = {
        name: find(kim["order"]["entries"], case="M(q), explicit time", alpha=-0.1, method=method)["order"]
        for name, method in {"printed": "non-iterative HHT, Eq. 13", "ours": "hht, predictor"}.items()
    }
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            kim=overview(kim),
            order=orders,
            cardona=numbers_of("cardona_geradin1989"),
            silverbox=numbers_of("identification", "silverbox"),
            pendulum=numbers_of("identification", "double_pendulum_measured"),
            stiff=numbers_of("identification", "stiff_joint"),
            c={
                x: find(benchmarks["against_c"]["single"], trigonometry=x, **single)["over_c"]
                for x in ("jnp", "polynomial")
            },
            gradient=gradient | {"MB": gradient["gradient_temporary_bytes"] / 1e6},
            work={
                "ours_ms": 1e3 * fastest("stiff double pendulum", "1e-06", PACKAGES[:1]),
                "theirs_ms": 1e3 * fastest("stiff double pendulum", "1e-06", PACKAGES[1:]),
                "scenes": len(times),
                "lost": len(lost),
                "least": min(lost),
                "most": max(lost),
            },
            sweeps=numbers_of("sweeps"),
        )
    )


if __name__ == "__main__":
    (HERE / "paper.md").write_text(page())
