"""The gallery with constraints: both formulations, with one solve and with Newton, on four mechanisms.

A cell is as good as the worse of q and of the multipliers L: index 3 with the trapezoidal rule has q right and L wrong.
"""

from functools import partial

from experiments.cells import position
from experiments.linearization.scenes import Case
from experiments.stability.pairs import Study, run_study
from hhtjax import hht
from hhtjax.scenes import pendulum, slider_crank, squeezer, top

METHODS = {
    "GGL\nNewton": partial(hht, formulation="ggl", iterations=None),
    "GGL\none solve": partial(hht, formulation="ggl"),
    "index 3\nNewton": partial(hht, formulation="index3", iterations=None),
    "index 3\none solve": partial(hht, formulation="index3"),
}
INDEX_3 = "Index 3 with alpha = 0: multipliers grow with every step, by a Jordan block; GGL has none."
CAUSES = {
    "pendulum on a rod": INDEX_3,
    "slider-crank": INDEX_3,
    "squeezer": "Only the coarsest steps are wrong; with GGL even they stay bounded.",
    "top on a rod": INDEX_3,
}


def cases() -> list[Case]:
    """A swinging point, a driven slider-crank, Andrews' squeezer, a spinning top."""
    return [
        Case("pendulum on a rod", pendulum.cartesian()._replace(duration=4.0), 16, "", fast=True),
        Case("slider-crank", slider_crank.driven(), 16, ""),
        Case("squeezer", squeezer.squeezer(), 32, ""),
        Case("top on a rod", top.constrained(), 32, ""),
    ]


def position_and_multipliers(state):
    """What is compared."""
    return position(state), state.L


def run(report, fast):
    """Grades every cell."""
    study = Study(cases(), METHODS, "GGL\nNewton", "GGL\none solve", 7, position_and_multipliers, causes=CAUSES)
    return run_study(report, study, "stability_constrained", fast)
