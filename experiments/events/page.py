"""README.md beside this file, made from page.md and events.json.

`python -m experiments.events.page`
"""

import json
from pathlib import Path

import numpy as np

from experiments.events import cost, gradients, parameters, peers
from experiments.page import table

HERE = Path(__file__).parent
PEERS = "diffrax", "MuJoCo", "exudyn"


def bars_table(numbers):
    """What was asked for, what was measured, and whether it holds."""
    least, lost = orders(numbers["order"])
    met, sweep = numbers["cost"]["rows"], numbers["cost"]["sweep"]
    ratios = [row["error_over_rtol"] for row in numbers["tolerance"]["rows"]]
    none_met, median = max(row["none_met_over_plain_time"] for row in met), float(np.median(ratios))
    within = float(np.mean([0.02 <= x <= 10 for x in ratios]))
    different, lowest_q = largest_difference(numbers), lowest(numbers)
    rows = [
        ["order of hht, worst quantity of five scenes", ">= 1.9", least["hht"], least["hht"] >= 1.9],
        ["order of rowda", ">= 2.8", least["rowda"], least["rowda"] >= 2.8],
        ["largest order, not located", "<= 1.6", lost, lost <= 1.6],
        ["derivatives - formula", "<= 1e-12", different, different <= 1e-12],
        ["lowest q on the way to rest (m)", ">= -1e-9", lowest_q, lowest_q >= -1e-9],
        ["time with an event that does not occur, over plain", "<= 2.2", none_met, none_met <= 2.2],
        [
            "time of a sweep of 64 with impacts, over plain",
            "<= 1.5",
            sweep["over_plain_time"],
            sweep["over_plain_time"] <= 1.5,
        ],
        ["error over rtol, median of all runs", "0.02 to 10", median, 0.02 <= median <= 10],
        ["share of these runs within 0.02 to 10", "1", within, within == 1],
    ]
    lines = [[what, bar, f"{x:.2g}" if abs(x) < 1e-3 else f"{x:.2f}", "yes" if holds else "**no**"]
             for what, bar, x, holds in rows]  # fmt: skip
    return table(["quantity", "target", "measured", "met"], lines)


def orders(rows):
    """The least order of each method with located events, and the largest one of all without."""
    located = [row for row in rows if row["way"] == "located"]
    least = {m: min(min(r["slopes"].values()) for r in located if r["method"] == m) for m in ("hht", "rowda")}
    return least, max(x for r in rows if r["way"] != "located" for x in r["slopes"].values())


def largest_difference(numbers):
    """Of derivatives."""
    return max(max(row["difference"]) for row in numbers["gradients"]["rows"])


def lowest(numbers):
    """Of all runs to rest."""
    return min(row["lowest_q_m"] for row in numbers["zeno"]["rows"])


def tolerances(rows):
    """Errors over rtol, and steps."""
    powers = sorted({row["rtol"] for row in rows}, reverse=True)
    lines = []
    for name, method in dict.fromkeys((row["scene"], row["method"]) for row in rows):
        mine = {row["rtol"]: row for row in rows if (row["scene"], row["method"]) == (name, method)}
        cells = [f"{mine[x]['error_over_rtol']:.2g} ({mine[x]['steps']})" if x in mine else "" for x in powers]
        lines.append([name, method, *cells])
    return table(["scene", "method", *(f"{x:.0e}" for x in powers)], lines)


def slopes(rows):
    """By scene, method and way."""
    names = {"q": "q", "v": "v", "multipliers": "multiplier"}
    lines = [
        [
            row["scene"],
            row["method"],
            row["way"],
            *(f"{row['slopes'][x]:.2f}" if x in row["slopes"] else "" for x in names),
        ]
        for row in rows
    ]
    return table(["scene", "method", "event", *names.values()], lines)


def times(rows):
    """Ratios, and what compilation takes."""
    lines = []
    for row in rows:
        ratios = [f"{row[f'{x}_over_plain_time']:.2f}" for x in ("none_met", "gradient")]
        compiling = [f"{x:.1f}" for x in row["compile_time_s"].values()]
        lines.append([row["scene"], f"{row['plain_ns_per_step']:.0f}", *ratios, *compiling])
    header = [
        "scene",
        "plain step (ns)",
        "ratio",
        "ratio, gradient",
        "compilation (s): plain",
        "events",
        "gradient, plain",
    ]
    return table([*header, "gradient, events"], lines)


def coverage(found):
    """How many intervals hold the truth."""
    lines = []
    for problem, x in found.items():
        for name, truth in x["truth"].items():
            shares = [f"{100 * by[name] / x['records']:.0f} %" for by in x["covered"].values()]
            lines.append([problem, name, f"{truth:g}", *shares, x["converged"]])
    kinds = next(iter(found.values()))["covered"]
    return table(["problem", "parameter", "truth", *kinds, "converged"], lines)


def beside(found):
    """Errors of q and of derivatives."""
    lines = [
        [
            name.replace("begun anew", "restarted"),
            x.get("steps", "adaptive"),
            f"{x['error_m']:.0e}",
            f"{x['derivative_difference']:.0e}",
        ]
        for name, x in found.items()
        if isinstance(x, dict) and "error_m" in x
    ]
    for name, x in found["rows"].items():
        stiffness = [f" ({k:.0e} N/m)" for k in x.get("stiffness_N_m", ())] or [""] * len(x["steps"])
        entries = zip(stiffness, x["steps"], x["error_m"], strict=True)
        lines += [[name + k, steps, f"{error:.1e}", "-"] for k, steps, error in entries]
    missing = {name for name in PEERS if not any(name in line[0] for line in lines)}
    lines += [[f"{name} was not installed", "", "", ""] for name in sorted(missing)]
    return table(["package", "steps", "error of q (m)", "error of derivatives"], lines)


def page(numbers):
    """The text of README.md."""
    found, doubling, zeno = numbers["parameters"], numbers["poincare"], numbers["zeno"]
    balls = numbers["gradients"]["two_balls"]
    least, lost = orders(numbers["order"])
    apart = max(row["difference_none_met"] for row in numbers["cost"]["rows"])
    after = [[n, *(f"{y:.3g}" for y in x)] for n, x in balls["after_the_step_by_steps"].items()]
    doublings = [
        [row["method"], n, f"{error:.1e}"]
        for row in doubling["rows"]
        for n, error in zip(row["steps_per_period"], row["frequency_error"], strict=True)
    ]
    kept = ("steps_to_rest", "max_events", "impacts", "flagged_step")
    rests = [[*(row[x] for x in kept), f"{row['error_m']:.0e}", f"{row['lowest_q_m']:.0e}"] for row in zeno["rows"]]
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=numbers["machine"],
            bars=bars_table(numbers),
            slopes=slopes(numbers["order"]),
            tolerances=tolerances(numbers["tolerance"]["rows"]),
            order_hht=least["hht"],
            order_rowda=least["rowda"],
            order_lost=lost,
            compile_most=max(max(row["compile_time_s"].values()) for row in numbers["cost"]["rows"]),
            none_met_most=max(row["none_met_over_plain_time"] for row in numbers["cost"]["rows"]),
            fit=numbers["tolerance"]["fit"],
            of_sweep=numbers["cost"]["sweep"],
            longest=gradients.LONGEST,
            duration=gradients.DURATION,
            gradient=largest_difference(numbers),
            formula=", ".join(f"{abs(x):.3g}" for x in balls["formula"]),
            after=table(["steps", "x1", "x2", "v1", "v2"], after),
            doubling=doubling["closed_form"]["doubling_rad_s"],
            doublings=table(["method", "steps per period", "error of W (rad/s)"], doublings),
            frequencies=doubling["diagram"]["frequencies"],
            failed=doubling["diagram"]["failed"],
            speed=doubling["speed_error_m_s"],
            restitution=zeno["restitution"],
            rest=zeno["rest_at_s"],
            zeno=table(["steps to rest", *(x.replace("_", " ") for x in kept[1:]), "error (m)", "lowest q (m)"], rests),
            steps=numbers["cost"]["steps"],
            gradient_steps=cost.GRADIENT_STEPS,
            apart=f"within {apart:.0e} of" if apart else "bit for bit",
            cost=times(numbers["cost"]["rows"]),
            impact_in_steps=numbers["cost"]["impacts"]["ns_per_impact"] / numbers["cost"]["impacts"]["ns_per_step"],
            **{f"impact_{key}": x for key, x in numbers["cost"]["impacts"].items()},
            records=found["bump stop"]["records"],
            samples=parameters.SAMPLES,
            noise=100 * parameters.NOISE,
            first=parameters.STEPS[0],
            second=parameters.STEPS[1],
            coverage=coverage(found),
            lost=found["bump stop, not located"]["converged"],
            won=found["bump stop"]["converged"],
            peer_duration=peers.DURATION,
            peers=beside(numbers["peers"]),
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "events.json").read_text())))
