"""paper.md and mbsd.md beside this file: templates filled with the numbers of the other folders, none copied by hand.

`python -m experiments.paper.page`
"""

import json
import math
import re
from pathlib import Path

from experiments.contact.page import slopes_of
from experiments.kim2019.page import overview
from experiments.page import find
from experiments.paper.tables import tables
from experiments.robots.accuracy import reached
from experiments.robots.page import usable
from experiments.sweeps.page import over_one
from experiments.work_precision.page import PACKAGES, STIFF, best

HERE = Path(__file__).parent
PAPERS = {"paper.md": "page.md", "mbsd.md": "mbsd_page.md"}  # for J. Open Source Software, Multibody System Dynamics
FORMULA = re.compile(r"\$\$.*?\$\$|\$.*?\$", flags=re.DOTALL)
SMOOTH_ARM = "UR5 on servos, set points that move smoothly"
GRADES = "silently_wrong", "beyond", "named", "accurate"
BEAM = {
    "exudyn": "beam, 3001 unknowns, over exudyn with modified Newton",
    "c": "the same over two-sided, vectorised C",
}


def numbers_of(folder, name=None):
    """The committed numbers of an experiment."""
    return json.loads((HERE.parent / folder / f"{name or folder}.json").read_text())


def numbers():
    """All numbers that a template may ask for."""
    names = "kim2019", "benchmarks", "cardona_geradin1989", "contact", "flexible", "friction", "robots", "stability"
    found = {name: numbers_of(name) for name in (*names, "sweeps", "work_precision")}
    found |= {
        name: numbers_of("identification", name)
        for name in ("silverbox", "double_pendulum_measured", "stiff_joint", "vehicle", "squeezer", "emps")
    }
    kim, benchmarks, robots = found["kim2019"], found["benchmarks"], found["robots"]
    gradient = find(benchmarks["gradients"]["long"], steps=100_000, saved="path")
    return found | {
        "tables": tables(found),
        "kim": overview(kim),
        "order": {
            name: find(kim["order"]["entries"], case="M(q), explicit time", alpha=-0.1, method=method)["order"]
            for name, method in {"printed": "non-iterative HHT, Eq. 13", "ours": "hht, predictor"}.items()
        },
        "cardona": found["cardona_geradin1989"],
        "pendulum": found["double_pendulum_measured"],
        "stiff": found["stiff_joint"],
        "friction": find(found["friction"]["equal_errors"], error_m=0.00015)
        | {
            "switches": found["friction"]["switches"],
            "crept_m": abs(found["friction"]["creep"]["q_m"]["set-valued"][-1]),
        },
        "contact": contacts(found["contact"]),
        "contact_cost": found["contact"]["cost"]["rows"],
        "arm": arm(find(robots["accuracy"]["cases"], case=SMOOTH_ARM)["methods"]),
        "loops": {"over_mujoco": robots["loops"]["us_a_step"] / robots["loops"]["mujoco_us_a_step"]},
        "beam": {x: find(found["flexible"]["scaling"]["aims"], aim=aim)["found"] for x, aim in BEAM.items()},
        "c": find(
            benchmarks["against_c"]["single"], trigonometry="jnp", method="non-iterative, predictor", saved="end"
        )["over_c"],
        "gradient": gradient | {"MB": gradient["gradient_temporary_bytes"] / 1e6},
        "gradient_error": {
            f"{e['h_s']:g}": e["relative_error"]
            for e in found["stiff_joint"]["gradients"]["rows"]
            if e["method"] == "non-iterative, alpha = 0"
        },
        "converged_gradient_error": find(
            found["stiff_joint"]["gradients"]["rows"], method="converged, alpha = 0", h_s=0.01
        )["relative_error"],
        "damping": {
            name: find(kim["linear"]["oscillator"], method=method, alpha=-0.05)["damping_ratio_at_wh_0.1"]
            for name, method in {"kim": "Kim's step", "hht": "hht"}.items()
        },
        "controlled_runs": sum(found["stability"]["adaptive"]["cells"]["no"][grade] for grade in GRADES),
        "emps": {
            "ours_mm": found["emps"]["models"][found["emps"]["chosen"]]["test_mm"],
            "published_mm": found["emps"]["published_parameters"]["test_mm"],
        },
        **constraints(found["cardona_geradin1989"]),
        "work": work(found["work_precision"]["times"]),
        "workers": {name: over_one(found["sweeps"]["workers"]["rows"], name) for name in ("processes, 2", "Dask, 2")},
    }


def contacts(found):
    """Observed orders within the bounds that were set, and all."""
    slopes = [slope for *_, slope in slopes_of(found["order"]["rows"])]
    inside = sum(1.85 <= slope <= 2.15 for slope in slopes)
    return {"inside": inside, "all": len(slopes), "least": min(slopes), "most": max(slopes)}


def arm(methods):
    """The error of the default with steps of 20 ms, and the steps with which MuJoCo comes to 1e-4 rad."""
    ours = methods["hht"]
    steps = {name: reached(usable(rows), 1e-4)["h_s"] for name, rows in methods.items() if name.startswith("MuJoCo")}
    return {"error_rad": ours["error_rad"][ours["h_s"].index(0.02)], "ms": {name: 1e3 * h for name, h in steps.items()}}


def constraints(cardona):
    """How far roots are from theory, errors of a pendulum's tension after 0.2, 1 and 2 s, and drift."""
    methods = {
        "index3": "trapezoidal rule, non-iterative",
        "ggl": "trapezoidal rule, non-iterative GGL",
        "hht": "HHT, alpha = -0.1, non-iterative",
    }
    pendulum = {
        name: find(cardona["pendulum"]["entries"], method=method, start="zero") for name, method in methods.items()
    }
    return {
        "roots": max(x["deviation_of_the_constraints_root"] for x in cardona["infinity"]["spectra"]),
        "tension": {
            name: {f"near {t} s": e[f"tension_error_near_{t}_s_N"] for t in ("0.2", "1", "2")}
            for name, e in pendulum.items()
        },
        "drift": find(cardona["drift"]["entries"], scene="slider-crank", method="HHT, non-iterative, GGL"),
    }


def work(times):
    """The fastest on the stiff double pendulum at 1e-6, and on how many scenes all of ours lose at 1e-8."""
    ours, theirs = PACKAGES[:1], PACKAGES[1:]

    def seconds(scene, level, packages):
        return best(times[scene], level, packages)[0] or math.nan

    ratios = [seconds(scene, "1e-08", ours) / seconds(scene, "1e-08", theirs) for scene in times]
    lost = [ratio for ratio in ratios if ratio > 1]
    return {
        "ours": best(times[STIFF], "1e-06", ours)[1],
        "ours_ms": 1e3 * seconds(STIFF, "1e-06", ours),
        "hht_ms": 1e3 * find(times[STIFF], method="hht")["time_s"]["1e-06"],
        "theirs": best(times[STIFF], "1e-06", theirs)[1],
        "theirs_ms": 1e3 * seconds(STIFF, "1e-06", theirs),
        "scenes": len(times),
        "lost": len(lost),
        "least": min(lost),
        "most": max(lost),
    }


def page(paper, found):
    """The text of a paper: its template with numbers for {fields}. Braces in formulas stay."""
    template = (HERE / PAPERS[paper]).read_text()
    braced = FORMULA.sub(lambda formula: formula[0].replace("{", "{{").replace("}", "}}"), template)
    return braced.format(**found)


if __name__ == "__main__":
    found = numbers()
    for paper in PAPERS:
        (HERE / paper).write_text(page(paper, found))
