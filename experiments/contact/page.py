"""README.md beside this file, made from page.md and contact.json.

`python -m experiments.contact.page`
"""

import json
import math
from pathlib import Path

from experiments.contact.order import IMPULSES, OURS, SPRINGS
from experiments.contact.other_ways import SWEEPS
from experiments.page import table

HERE = Path(__file__).parent


def small(x, digits=1):
    """A number, or what there is instead."""
    return "not finite" if x is None or math.isinf(x) else f"{x:.{digits}e}"


def times(x):
    """A ratio."""
    return f"{x:.0f}" if x >= 10 else f"{x:.1f}"


def machine(made_by):
    """In a few words."""
    made = made_by if "cores" in made_by else next(iter(made_by["parts"].values()))
    return f"{made['cores']} cores ({made['processor']}), jax {made['jax']}"


def slopes_of(rows):
    """(scene, alpha, kind, slope) of those that are no rounding."""
    return [(r["scene"], r["alpha"], kind, x) for r in rows for kind, x in r["slopes"].items() if x is not None]


def worst(values):
    """The largest; infinite where one is not finite."""
    return max(math.inf if x is None else x for x in values)


def differences(row, key):
    """The largest relative one, of steps at which the derivative is not 0: the block rests too early with 40."""
    none = 1e-9 * max(abs(x) for x in row["forward"])
    return worst([x for x, derivative in zip(row[key], row["forward"], strict=True) if abs(derivative) > none])


def bars_table(numbers):
    """What was asked for, what was measured, and whether it holds."""
    slopes, cost = slopes_of(numbers["order"]["rows"]), numbers["cost"]["rows"]
    values = [x for *_, x in slopes]
    inside = sum(1.85 <= x <= 2.15 for x in values)
    closed, derivatives = numbers["closed_forms"], numbers["derivatives"]["rows"]
    forms, stack = closed["slopes"] + closed["rolling"], closed["stack"]
    gaps = numbers["limits"]["gaps"]
    lowest = min(row["lowest_gap_m"] for row in gaps if not row["failed_step"])
    reverse, central = (
        worst([differences(row, key) for row in derivatives])
        for key in ("forward_minus_reverse", "difference_from_central")
    )
    ratio = {what: x["ratio_of_times"] for what, x in cost.items() if "ratio_of_times" in x}
    error, derivative = (worst([x[key] for x in forms]) for key in ("error_m", "derivative_error"))
    compiling = cost["step"]["compile_time_s"][0]
    spread = f"{min(values):.2f} to {max(values):.2f}, {inside} of {len(values)} inside"
    rows = [
        ["order of q, v, forces; 5 scenes, 3 alphas", "1.85 to 2.15", spread, inside == len(values)],
        ["error against formulas, 40 steps", "1e-10", small(error), error <= 1e-10],
        ["error of their derivatives", "1e-9", small(derivative), derivative <= 1e-9],
        ["lowest gap (m)", ">= -1e-12", small(lowest), lowest >= -1e-12],
        ["movement of a stack at rest (m)", "1e-15", small(stack["moved_m"]), stack["moved_m"] <= 1e-15],
        ["error of its forces (N)", "1e-12", small(stack["force_error_N"]), stack["force_error_N"] <= 1e-12],
        ["derivatives - central differences, relative", "1e-8", small(central), central <= 1e-8],
        ["reverse - forward, relative", "1e-12", small(reverse), reverse <= 1e-12],
        ["time of a step without a switch, over plain", "5", times(ratio["step"]), ratio["step"] <= 5],
        ["cold: compilation (CPU s)", "8", f"{compiling:.1f}", compiling <= 8],
        ["time of forward mode, over plain", "20", times(ratio["forward"]), ratio["forward"] <= 20],
        ["time of a batch of 64, over plain", "1.5", times(ratio["batch"]), ratio["batch"] <= 1.5],
    ]
    return table(["quantity", "target", "measured", "met"], [[*row[:3], "yes" if row[3] else "**no**"] for row in rows])


def orders_table(rows):
    """Slopes and errors at two sizes."""
    lines = []
    for row in rows:
        at = [row["error_q"][row["steps"].index(n)] for n in (160, 2560)]
        slopes = ["exact" if x is None else f"{x:.2f}" for x in row["slopes"].values()]
        lines.append([row["scene"], row["alpha"], *slopes, *map(small, at)])
    header = ["scene", "alpha", "slope of q", "slope of v", "slope of forces", "error of q, 160 steps", "2560 steps"]
    return table(header, lines)


def closed_table(closed):
    """Errors of what has a formula."""
    rows = [[x["what"], small(x["error_m"]), small(x["derivative_error"])] for x in closed["slopes"]]
    for x in closed["rolling"]:
        what = f"{x['what']}, loses {x['lost']:.6f} of its speed (formula {x['formula']:.6f})"
        rows.append([what, small(x["error_m"]), small(x["derivative_error"])])
    return table(["motion", "error (m, m/s)", "error of derivative"], rows)


def stack_words(stack):
    """What three boxes do."""
    stuck = ", ".join(f"{small(stack[f'stuck_error_m_{n}'])} m ({n} steps)" for n in (200, 1000))
    gap, named = small(stack["slipping_gap_m"]), stack["slipping_named_step"]
    return (
        f"Three boxes on each other move {small(stack['moved_m'])} m in {stack['rest_s']:g} s, and their normal "
        f"forces have errors of at most {small(stack['force_error_N'])} N. On a floor that shakes with 0.65 mu g they "
        f"stick. Their distance from A sin(W t) is then {stuck}. With 2.4 mu g they slip, and with 200 steps gaps stay "
        f"below {gap} m" + (f" (`check()` reports a failure in step {named})." if named else ".")
    )


def ways_table(rows):
    """Errors and times at some sizes."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for steps in dict.fromkeys(row["steps"] for row in rows):
            by = {row["way"]: row for row in rows if (row["scene"], row["steps"]) == (scene, steps)}
            entries = [by.get(way) for way in (OURS, IMPULSES, *SPRINGS)]
            cells = ["" if x is None else f"{small(x['error_q'])} ({1e3 * x['time_s']:.3g} ms)" for x in entries]
            lines.append([scene, steps, *cells])
    return table(["scene", "steps", OURS, "impulses", *SPRINGS], lines)


def ball(rows):
    """Errors of the ball with 640 steps, by each way."""
    by = {row["way"]: row["error_q"] for row in rows if (row["scene"], row["steps"]) == ("ball", 640)}
    springs = min(math.inf if by[way] is None else by[way] for way in SPRINGS)
    return {"ball_ours": small(by[OURS]), "ball_impulses": small(by[IMPULSES]), "ball_springs": small(springs)}


def springs_win(rows):
    """Where springs reach 2 mm in less time than the fewest steps with contacts."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        enough = [r for r in rows if r["scene"] == scene and r["error_q"] is not None and r["error_q"] <= 2e-3]
        ours = min((r["time_s"] for r in enough if r["way"] == OURS), default=math.inf)
        soft = min((r["time_s"] for r in enough if r["way"] in SPRINGS), default=math.inf)
        by_springs = "never reach 2 mm" if math.isinf(soft) else f"reach 2 mm in {1e3 * soft:.2f} ms"
        lines.append(f"{scene}: springs {by_springs}, contacts in {1e3 * ours:.2f} ms")
    return "; ".join(lines)


def mujoco_table(peers, ways):
    """Errors of the block."""
    if "mujoco" not in peers:
        return "MuJoCo was not installed."
    rows = [
        [OURS, x["steps"], small(x["error_q"]), f"{1e3 * x['time_s']:.3g}"]
        for x in ways
        if x["scene"] == "rock" and x["way"] == OURS
    ]
    rows += [
        [f"MuJoCo, {x['setting']}", x["steps"], small(x["error_q"]), f"{1e3 * x['time_s']:.3g}"]
        for x in peers["mujoco"]["rock"]
    ]
    return table(["method", "steps", "error of q", "ms"], rows)


def creep_words(peers, slopes):
    """Of the slope."""
    held = next(x for x in slopes if x["way_m"] == 0)
    words = [f"{small(held['error_m'])} m in a second with `Contact`"]
    words += [
        f"{small(x)} m/s in MuJoCo ({name})" for name, x in peers.get("mujoco", {"creep_m_s": {}})["creep_m_s"].items()
    ]
    return ", ".join(words)


def exudyn_words(peers):
    """Of the disc."""
    if "exudyn" not in peers:
        return "exudyn was not installed."
    rows = [f"{small(x['error_v'])} ({x['steps']})" for x in peers["exudyn"]["disc"]]
    rolls = "exudyn's rolling disc with a spring of 1e6 N/m should end at 2/3 of its speed. Its errors"
    return f"{rolls} in m/s (steps) are: {', '.join(rows)}."


def derivatives_table(rows):
    """Forward against reverse, differences, and the motion."""
    lines = []
    for row in rows:
        motion = row["forward"][-1] if row["of_DOP853"] is None else row["of_DOP853"]
        errors = [
            abs(x / motion - 1) if x is not None else None
            for x in (row["forward"][2], row["impulses"][-1], row["springs"][-1])
        ]
        pairs = (differences(row, key) for key in ("forward_minus_reverse", "difference_from_central"))
        lines.append([f"{row['scene']}, {row['parameter']}", f"{motion:.5g}", *map(small, pairs), *map(small, errors)])
    return table(["parameter", "motion", "- reverse", "- differences", "Contact", "impulses", "springs"], lines)


def coverage_table(fit):
    """How many intervals hold the truth."""
    kinds = fit["covered"]
    rows = []
    for name, truth in fit["truth"].items():
        _, low, high = fit["over_truth_with_interval"][name]
        half = sorted((b - a) / 2 for a, b in zip(low, high, strict=True))[len(low) // 2]
        rows.append(
            [name, f"{truth:g}", *(f"{by[name]} of {fit['records']}" for by in kinds.values()), f"{100 * half:.2g} %"]
        )
    return table(["parameter", "truth", *kinds, "median half-width"], rows)


def energy_table(rows):
    """Of free motions."""
    lines = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        mine = [row for row in rows if row["scene"] == scene]
        cells = [small(row["largest_rise_J"]) if row["largest_rise_J"] > 0 else "0" for row in mine]
        lines.append([scene, f"{mine[-1]['lost_J']:.3g}", *cells])
    steps = dict.fromkeys(row["steps"] for row in rows)
    return table(["scene", "energy lost (J)", *(f"largest rise (J), {n} steps" for n in steps)], lines)


def member_ratio(cost):
    """The time of a step of a member of the batch, beside that of a run alone."""
    step, batch = (cost["rows"][what]["contact_time_s"] for what in ("step", "batch"))
    return f"{batch / cost['members'] / cost['member_steps'] / (step / cost['steps']):.2f}"


def cost_table(cost):
    """Ratios."""
    names = {
        "step": "a step",
        "forward": "forward mode, one direction",
        "reverse": "reverse mode",
        "batch": f"a batch of {cost['members']}",
    }
    sizes = {"step": cost["steps"]}
    rows = []
    for what, name in names.items():
        x = cost["rows"][what]
        per = (
            f"{1e9 * x['plain_time_s'] / sizes[what]:.0f} ns" if what in sizes else f"{1e3 * x['plain_time_s']:.3g} ms"
        )
        rows.append(
            [
                name,
                per,
                times(x["ratio_of_times"]),
                f"{x['compile_time_plain_s'][0]:.1f}",
                f"{x['compile_time_s'][0]:.1f}",
            ]
        )
    return table(
        ["program", "plain, warm", "ratio with contacts, warm", "compilation, plain (CPU s)", "with contacts (CPU s)"],
        rows,
    )


def page(numbers):
    """The text of README.md."""
    order, peers, fit, limits = (numbers[part] for part in ("order", "peers", "parameters", "limits"))
    springs = [row for row in order["ways"] if row["way"] in SPRINGS]
    wrong = [row for row in springs if row["error_q"] is None or row["error_q"] > 0.1]
    failed = [row for row in limits["gaps"] if row["failed_step"]]
    checks = (
        f"{name}: {', '.join(map(small, x['deviation_of_reference_from_DOP853']))}"
        for name, x in order["references"].items()
    )
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=machine(numbers["made_by"]),
            sweeps=SWEEPS,
            **ball(order["ways"]),
            compile_s=numbers["cost"]["rows"]["step"]["compile_time_s"][0],
            bars=bars_table(numbers),
            samples=order["samples"],
            reference_steps=order["reference_steps"],
            checks="; ".join(checks),
            orders=orders_table(order["rows"]),
            closed_steps=numbers["closed_forms"]["steps"],
            closed=closed_table(numbers["closed_forms"]),
            stack=stack_words(numbers["closed_forms"]["stack"]),
            ways=ways_table(order["ways"]),
            springs_wrong=f"{len(wrong)} of {len(springs)}",
            springs_named=sum(row["named"] for row in wrong) or "none",
            springs_win=springs_win(order["ways"]),
            mujoco=mujoco_table(peers, order["ways"]),
            creep=creep_words(peers, numbers["closed_forms"]["slopes"]),
            exudyn=exudyn_words(peers),
            derivatives=derivatives_table(numbers["derivatives"]["rows"]),
            fit_samples=fit["samples"],
            fit_steps=" and ".join(map(str, fit["steps"])),
            records=fit["records"],
            converged=fit["converged"],
            coverage=coverage_table(fit),
            lowest_gap=min(row["lowest_gap_m"] for row in limits["gaps"]),
            gap_failed=f"{len(failed)} runs end with a reported failure" if failed else "no run fails",
            energy=energy_table(limits["energy"]),
            member_ratio=member_ratio(numbers["cost"]),
            cost=cost_table(numbers["cost"]),
            ball_us=", ".join(
                f"{x:.2g} us per step with {n} steps" for n, x in numbers["cost"]["rows"]["switches_time"].items()
            ),
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "contact.json").read_text())))
