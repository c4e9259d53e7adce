"""The tables of the longer paper."""

from collections import Counter

from experiments.kim2019.page import orders_table
from experiments.page import find, table
from experiments.robots.page import cell, short
from experiments.stability.page import summary_table
from experiments.work_precision.page import PACKAGES, best, ms

FIVE = "HHT converged", "HHT auto", "HHT predictor", "HHT held", "HHT state", "Kim 2019"
CALLS = "simulate", "gradient", "fit"
PROGRAMS = "hht", "MuJoCo RK4", "MuJoCo implicitfast", "exudyn generalized alpha"
FOUND = "A", "b", "w", "X"  # accurate, bounded, silently wrong, blown up


def tables(found):
    """By name."""
    gallery, stability = found["stability"]["gallery"], found["stability"]
    return {
        "orders": orders_table(found["kim2019"]["order"]["entries"]),
        "tuned": gallery_table(gallery["summary_tuned_on"]),
        "held_out": gallery_table(gallery["summary_held_out"]),
        "constrained": constrained_table(stability["constrained"]),
        "squeezer": newton_table(found["cardona_geradin1989"]["work_precision"]["newton_tolerances"]),
        "robots": robots_table(found["robots"]["accuracy"]["cases"]),
        "precision": precision_table(found["work_precision"]["times"]),
        "cold": cold_table(found["benchmarks"]["first_call"]["rows"]),
        "intervals": intervals_table(found),
    }


def gallery_table(rows):
    """Shares of runs with alpha = -0.05, by method."""
    return summary_table([row for row in rows if row["method"] in FIVE and row["alpha"] == -0.05])


def constrained_table(scenes):
    """Runs of all scenes with constraints by grade, for each form and way to solve."""
    grades = {}
    for scene in scenes.values():
        for method, letters in scene["grades"].items():
            grades.setdefault(method, Counter()).update("".join(letters))
    rows = [[method, *(count[letter] for letter in FOUND)] for method, count in grades.items()]
    return table(["", "accurate", "bounded", "silently wrong", "blown up"], rows)


def newton_table(entries):
    """One solve and Newton's iteration on the squeezer."""
    rows = [
        [
            f"{e['method']}, {'GGL' if e['formulation'] == 'ggl' else 'index 3'}",
            "-" if e["newton_tolerance_N_m"] is None else f"{e['newton_tolerance_N_m']:g}",
            f"{e['solves_per_step']:.2f}",
            f"{e['cpu_time_per_step_us']:.1f}",
            f"{e['q_error_rad']:.2e}",
        ]
        for e in entries
    ]
    return table(["", "tolerance (N m)", "solves a step", "us a step, warm", "error of q (rad)"], rows)


def robots_table(cases):
    """Step size and time of a run, for an error of 1e-4 rad."""
    rows = []
    for case in cases:
        found = case["methods"]
        name = short(case) if case["n"] != 6 else f"UR5, {short(case)}"
        rows.append([name, case["n"], *(cell(found[m], 1e-4) if m in found else "" for m in PROGRAMS)])
    return table(["", "n", *PROGRAMS], rows)


def precision_table(times):
    """Times to an error of 1e-6, of the default, the best of ours and the best other."""
    rows = []
    for scene, entries in times.items():
        (ours, method), (theirs, peer) = best(entries, "1e-06", PACKAGES[:1]), best(entries, "1e-06", PACKAGES[1:])
        default = find(entries, method="hht")["time_s"]["1e-06"]
        rows.append([scene, ms(default), f"{ms(ours)} ({method})", f"{ms(theirs)} ({peer})"])
    return table(["", "`hht` (ms)", "best of ours (ms)", "best other (ms)"], rows)


def cold_table(rows):
    """CPU seconds of a first call; after the stroke those of another process that finds compiled programs on disk."""
    scenes = dict.fromkeys(row["scene"] for row in rows)
    cells = [
        [
            scene,
            *(
                f"{e['cpu_time_s']['total']:.1f} / {e['with_cache_cpu_time_s']:.1f}"
                for e in (find(rows, scene=scene, call=call) for call in CALLS)
            ),
        ]
        for scene in scenes
    ]
    return table(["", *CALLS], cells)


def intervals_table(found):
    """Records whose 95 % interval of one stiffness holds the truth, by step size."""
    stiff, vehicle, squeezer = found["stiff_joint"]["recovery"], found["vehicle"], found["squeezer"]
    cases = {
        "stiff joint, k1": (stiff, "k1"),
        "vehicle, front tyre": (vehicle, "k_tyre front"),
        "squeezer, spring": (squeezer, "c0"),
    }
    rows = [
        [name, x["records"], *(x["covered"][steps][key] for steps in ("h", "h/2", "Richardson"))]
        for name, (x, key) in cases.items()
    ]
    return table(["", "records", "h", "h/2", "extrapolated in h"], rows)
