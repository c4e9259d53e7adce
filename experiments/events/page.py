"""README.md beside this file, made from page.md and events.json.

`python -m experiments.events.page`
"""

import json
from pathlib import Path

from experiments.events import cost, gradients, parameters, peers
from experiments.page import table

HERE = Path(__file__).parent


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
    return table(["scene", "", "", *names.values()], lines)


def times(rows):
    """Ratios, and what compilation takes."""
    lines = []
    for row in rows:
        ratios = [f"{row[f'{x}_over_plain_time']:.2f}" for x in ("none_met", "gradient")]
        compiling = [f"{x:.1f}" for x in row["compile_time_s"].values()]
        lines.append([row["scene"], f"{row['plain_ns_per_step']:.0f}", *ratios, *compiling])
    header = ["scene", "ns of a plain step", "none met", "gradient", "compile (s): plain", "events", "gradient, plain"]
    return table([*header, "gradient, events"], lines)


def coverage(found):
    """How many intervals hold the truth."""
    lines = []
    for problem, x in found.items():
        for name, truth in x["truth"].items():
            shares = [f"{100 * by[name] / x['records']:.0f} %" for by in x["covered"].values()]
            lines.append([problem, name, f"{truth:g}", *shares, x["converged"]])
    kinds = next(iter(found.values()))["covered"]
    return table(["", "", "truth", *kinds, "converged"], lines)


def beside(found):
    """Errors of q and of derivatives."""
    lines = [
        [name, x.get("steps", "adaptive"), f"{x['error_m']:.0e}", f"{x['derivative_difference']:.0e}"]
        for name, x in found.items()
        if isinstance(x, dict) and "error_m" in x
    ]
    for name, x in found["rows"].items():
        lines += [[name, steps, f"{error:.1e}", ""] for steps, error in zip(x["steps"], x["error_m"], strict=True)]
    return table(["", "steps", "error of q (m)", "of derivatives"], lines)


def page(numbers):
    """The text of README.md."""
    found, doubling, zeno = numbers["parameters"], numbers["poincare"], numbers["zeno"]
    balls = numbers["gradients"]["two_balls"]
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
            slopes=slopes(numbers["order"]),
            longest=gradients.LONGEST,
            duration=gradients.DURATION,
            gradient=max(max(row["difference"]) for row in numbers["gradients"]["rows"]),
            formula=", ".join(f"{abs(x):.3g}" for x in balls["formula"]),
            after=table(["steps", "x1", "x2", "v1", "v2"], after),
            doubling=doubling["closed_form"]["doubling_rad_s"],
            doublings=table(["", "steps of a period", "error of W (rad/s)"], doublings),
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
