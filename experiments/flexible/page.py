"""README.md beside this file, made from page.md and flexible.json.

`python -m experiments.flexible.page`
"""

import json
from pathlib import Path

from experiments.flexible import statics
from experiments.page import table

HERE = Path(__file__).parent
TARGETS = {"spin-up": (1e-4, 1e-5, 2e-6), "falling beam": (1e-2, 1e-3, 1e-4)}  # m


def short(x, digits=3):
    """A number to so many digits, without an exponent where that is readable."""
    if x is None:
        return ""
    return f"{x:,.0f}" if abs(x) >= 10 ** (digits - 1) else f"{x:.{digits}g}"


def costs(rows):
    """The table of all ways and sizes."""
    lines = [
        [row["scene"], f"{row['unknowns']:,}", row["way"], short(row["us_per_step"]),
         short(row["ns_per_step_and_unknown"]), short(row["first_call_cpu_s"], 2)]
        for row in rows
    ]  # fmt: skip
    return table(["scene", "unknowns", "method", "us per step", "ns per step and unknown", "first call (CPU s)"], lines)


def exponents(found):
    """Of ways with several sizes."""
    lines = [[scene, way, f"{x:.2f}"] for scene, ways in found.items() for way, x in ways.items()]
    return table(["scene", "method", "exponent"], lines)


def gradients(found):
    """Time and memory."""
    lines = [
        [name, short(x["us_per_step"]), f"{x['over_value']:.2f}", f"{x['temporary_MB']:.2g}", short(x["compile_cpu_s"])]
        for name in ("value", "forward", "reverse")
        for x in [found[name]]
    ]
    return table(["program", "us per step", "ratio to value", "temporary memory (MB)", "compilation (CPU s)"], lines)


def aims(rows):
    """With a yes or a no."""
    lines = [[x["aim"], short(x["at_most"]), short(x["found"]), "yes" if x["met"] else "**no**"] for x in rows]
    return table(["quantity", "target (at most)", "measured", "met"], lines)


def scenes(rows):
    """What was found and what is known."""
    lines = []
    for x in rows:
        numbers = [f"{x[key]:.7g}" for key in ("found", "known")]
        far = f"{x['difference']:.1e}{', relative' if x['relative'] else ''}"
        met = "yes" if x["met"] else "**no**"
        lines.append([x["scene"], x["quantity"], *numbers, x["source"], far, f"{x['aim']:.0e}", met])
    return table(["scene", "quantity", "found", "known", "source", "difference", "target (at most)", "met"], lines)


def accuracy(found):
    """The least seconds of each way within an error."""
    lines, header = [], ["scene", "error below (m)"]
    ways = list(dict.fromkeys(row["way"] for rows in found.values() for row in rows))
    for scene, targets in TARGETS.items():
        for target in targets:
            line = [scene, f"{target:.0e}"]
            for way in ways:
                near = [
                    row["seconds"]
                    for row in found[scene]
                    if row["way"] == way and row["tip_error_m"] is not None and row["tip_error_m"] <= target
                ]
                line.append(f"{short(1e3 * min(near))} ms" if near else "")
            lines.append(line)
    return table([*header, *ways], lines)


def fit(found):
    """The estimates."""
    lines = []
    for name in ("EI", "damping"):
        x = found[name]
        estimate = f"{x['fitted']:.6g} +- {1.96 * x['standard_error']:.2g}"
        lines.append([name, f"{x['truth']:.6g}", f"{x['start']:.6g}", estimate, x["unit"]])
    return table(["parameter", "true", "start", "fit, 95 %", "unit"], lines)


def page(numbers):
    """The text of README.md."""
    scaling, seen, material = numbers["scaling"], numbers["scenes"], numbers["material"]
    last = seen["cantilever"][-1]
    aim = {row["aim"]: row["found"] for row in scaling["aims"]}.__getitem__
    cost = {row["scene"]: row for row in seen["costs"]}
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=numbers["machine"],
            repeats=5,
            over_c=aim("beam, 3001 unknowns, over plain C"),
            over_exudyn=aim("beam, 3001 unknowns, over exudyn with modified Newton"),
            exponent=scaling["exponents"]["beam"]["elements"],
            rows=costs(scaling["rows"]),
            exponents=exponents(scaling["exponents"]),
            gradients=gradients(scaling["gradients"]),
            gradient_unknowns=scaling["gradients"]["unknowns"],
            gradient_steps=scaling["gradients"]["num_steps"],
            slope_difference=scaling["gradients"]["slope_difference"],
            aims=aims(scaling["aims"]),
            scenes=scenes(seen["rows"]),
            spin_up_s=cost["spin_up"]["seconds"],
            settling=round(statics.SETTLED / statics.DT),
            elastica=f"{last['error_m']:.0e}",
            elastica_elements=last["elements"],
            by_mesh=1e3 * seen["four_bar"]["by_mesh_m"],
            by_step=1e3 * seen["four_bar"]["by_step_m"],
            largest=1e3 * seen["four_bar"]["largest_m"],
            violation=seen["four_bar"]["violation_m"],
            rope_unknowns=cost["rope"]["unknowns"],
            rope_s=cost["rope"]["seconds"],
            rope_farthest=seen["farthest_by_predictor_m"],
            accuracy=accuracy(numbers["accuracy"]),
            fit=fit(material),
            fit_unknowns=material["unknowns"],
            fit_steps=material["num_steps"],
            fit_iterations=material["iterations"],
            fit_s=material["seconds"],
            noise=1e3 * material["noise_m"],
            gradient_parameters=material["gradient"]["parameters"],
            gradient_s=material["gradient"]["seconds"],
            gradient_sum=material["gradient"]["sum_less_forward_over_it"],
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "flexible.json").read_text())))
