"""README.md beside this file, made from page.md and the numbers of eight experiments.

`python -m experiments.identification.page`
"""

import json
from pathlib import Path

import numpy as np

from experiments.page import find, table

HERE = Path(__file__).parent
SHOWN = ("non-iterative, alpha = 0", "non-iterative, alpha = -0.3", "converged, alpha = 0", "Kim's step, alpha = 0")
STEPS = 0.04, 0.01, 0.0025  # s
MEASURED = "silverbox", "silverbox_comparison", "double_pendulum_measured", "bouc_wen", "emps"
GENERATED = "stiff_joint", "vehicle", "squeezer"


def read():
    """{experiment: its numbers}."""
    return {name: json.loads((HERE / f"{name}.json").read_text()) for name in MEASURED + GENERATED}


def silverbox_pieces(numbers):
    """Tables of Silverbox: scores, errors over scatter, Richardson's values."""
    sets = {"train": "training", "arrow_full": "arrow, full", "arrow_no_extrapolation": "arrow, no extrapolation"}
    sets["multisine"] = "multisine"
    models = numbers["models"]
    scores = [[name, *(f"{m[f'{part}_mV']:.3f} mV" for part in sets)] for name, m in models.items()]
    ratios = {
        name: {p: r for p, r in m["standard_error_over_scatter"].items() if isinstance(r, dict)}
        for name, m in models.items()
    }
    columns = list(ratios["10 parameters"])
    rows = [[n, *(f"{by[c]['cluster']:.2f}" if c in by else "" for c in columns)] for n, by in ratios.items()]
    naive = [r["naive"] for by in ratios.values() for r in by.values()]
    agreement = numbers["by_step_size"]["richardson_agreement"]
    return {
        "silverbox": table(["model", *sets.values()], scores),
        "silverbox_parts": models["10 parameters"]["standard_error_over_scatter"]["parts"],
        "scatter": table(["model", *columns], rows),
        "naive_least": min(naive),
        "naive_most": max(naive),
        "richardson": table(
            ["", "k/m", "c/m"], [[n, *(f"{by[x]:.1e}" for x in ("k/m", "c/m"))] for n, by in agreement.items()]
        ),
    }


def far_table(far):
    """Starts that arrive, and the slowest, by solver."""
    rows = [
        [
            solver,
            *(f"{by[solver]['right']} of {by[solver]['of']}, {by[solver]['slowest_s']:.2g} s" for by in far.values()),
        ]
        for solver in next(iter(far.values()))
    ]
    return table(["", *far], rows)


def pendulum_pieces(numbers):
    """Tables of the measured double pendulum."""
    lengths = [f"{x:g} s" for x in numbers["windows_s"]]

    def errors(rows):
        return table(
            ["fitted", *lengths], [[n, *(f"{x:.3f}" for x in row)] for n, row in zip(lengths, rows, strict=True)]
        )

    tests = (f"{value:.2f} mrad over {length}" for length, value in numbers["test_mrad"].items())
    return {
        "unseen": errors(numbers["unseen_mrad"]),
        "held_out": errors(numbers["held_out_mrad"]),
        "test": ", ".join(tests),
        "long_windows": table(
            ["friction, fit", "mrad"], [[n, f"{x:.4g}"] for n, x in numbers["long_windows_mrad"].items()]
        ),
    }


def bouc_wen_pieces(numbers):
    """Tables of Bouc-Wen's hysteresis."""
    by_steps = [
        [f"{row['substeps']}, alpha = {row['alpha']:g}", f"{row['multisine_m']:.2g} m",
         f"{row['sinesweep_m']:.2g} m" if "sinesweep_m" in row else ""]
        for row in numbers["true_parameters"]
    ]  # fmt: skip
    half = numbers["with_half_the_step"]
    names = list(numbers["off_by_percent"])
    off = [
        [f"{by['substeps']} steps", *(f"{by['off_by_percent'][name]:+.3f} %" for name in names)]
        + [f"{by[f'{test}_error_m']:.2g} m" for test in ("multisine", "sinesweep")]
        for by in (numbers, half)
    ]
    return {
        "bouc_wen_steps": table(["steps in a sample", "multisine", "sweep"], by_steps),
        "bouc_wen_off": table(["in a sample", *names, "multisine", "sweep"], off),
        "bouc_wen_train": numbers["train_error_m"],
        "bouc_wen_others": ", ".join(f"{x:.2g} m ({name})" for name, x in numbers["black_boxes_multisine_m"].items()),
    }


def emps_pieces(numbers):
    """Tables of the positioning axis."""
    models = [
        [name, f"{row['parameters']}", *(f"{row[f'{what}_mm']:.2f} mm" for what in ("train", "held_out")),
         f"{row['behind_the_best']:.1f}" if row["behind_the_best"] else "best",
         f"{row['test_mm']:.2f} mm"]
        for name, row in numbers["models"].items()
    ]  # fmt: skip
    found, keys = numbers["estimate"], [key for key in numbers["estimate"] if f"lower_{key}" in numbers["estimate"]]
    rows = [
        [key.split("_in_")[0], f"{found[key]:.4g}", f"{found[f'lower_{key}']:.4g} .. {found[f'upper_{key}']:.4g}",
         key.split("_in_")[1].replace("_", " ")]
        for key in keys
    ]  # fmt: skip
    chosen, other = numbers["models"][numbers["chosen"]], numbers["other_friction"]
    before, after = numbers["force_regression"]["train"], numbers["force_regression"]["test"]
    header = ["model", "parameters", "training", "left out", "standard errors behind", "test"]
    return {
        "emps_models": table(header, models),
        "emps_chosen": numbers["chosen"],
        "emps_parameters": chosen["parameters"],
        "emps_test": chosen["test_mm"],
        "emps_published": numbers["published_parameters"]["test_mm"],
        "emps_estimate": table(["parameter", "estimate", "95 % interval", "unit"], rows),
        "emps_observations": numbers["observations"],
        "emps_worth": numbers["worth_independent"],
        "emps_naive": " to ".join(f"{x:.0f}" for x in numbers["standard_error_over_naive"]),
        "emps_own": other["test_mm"],
        "emps_more": 100 * (other["Fc_over_training"] - 1),
        "emps_fv": 100 * (after["Fv_in_N_s/m"] / before["Fv_in_N_s/m"] - 1),
        "emps_fc": 100 * (after["Fc_in_N"] / before["Fc_in_N"] - 1),
    }


def covered(found):
    """Intervals that hold the truth, and their median half-width."""
    names = list(found["over_truth_with_interval"])
    rows = [[kind, *(by[name] for name in names)] for kind, by in found["covered"].items()]
    widths = (np.median(np.diff(np.log(x[1:]), axis=0)) / 2 for x in found["over_truth_with_interval"].values())
    rows.append(["median half-width", *(f"{100 * w:.2g} %" for w in widths)])
    return table([f"of {found['records']}, steps", *names], rows)


def gradients_table(rows):
    """Errors and times at some steps."""
    lines = []
    for method in SHOWN:
        entries = (find(rows, method=method, h_s=h) for h in STEPS)
        lines.append([method, *(f"{e['relative_error']:.1e}, {1e3 * e['seconds']:.1f} ms" for e in entries)])
    return table(["method", *(f"h = {h:g} s" for h in STEPS)], lines)


def page(numbers):
    """The text of README.md."""
    stiff, gradients = numbers["stiff_joint"]["recovery"], numbers["stiff_joint"]["gradients"]["rows"]
    vehicle = numbers["vehicle"]
    ours = find(gradients, method=SHOWN[0], h_s=STEPS[-1])
    theirs = find(gradients, method="diffrax Kvaerno5", tolerance=1e-6)
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            **silverbox_pieces(numbers["silverbox"]),
            piece=numbers["silverbox_comparison"]["far_starts_samples"],
            far=far_table(numbers["silverbox_comparison"]["far_starts"]),
            **pendulum_pieces(numbers["double_pendulum_measured"]),
            **bouc_wen_pieces(numbers["bouc_wen"]),
            **emps_pieces(numbers["emps"]),
            stiff_records=stiff["records"],
            stiff_converged=stiff["converged"],
            stiff_cost=stiff["largest_cost_per_residual"],
            stiff_seconds=stiff["fit_time_s"],
            stiff_k2=stiff["determined"]["k2"],
            stiff=covered(stiff),
            gradients=gradients_table(gradients),
            diffrax=f"diffrax's Kvaerno5 with a tolerance of 1e-6 and its default adjoint takes "
            f"{1e3 * theirs['seconds']:.0f} ms for {theirs['relative_error']:.1e}; the non-iterative step "
            f"{1e3 * ours['seconds']:.1f} ms for {ours['relative_error']:.1e}.",
            vehicle_noise=vehicle["noise"],
            vehicle_records=vehicle["records"],
            vehicle=covered(vehicle),
            vehicle_other=max(vehicle["other_road_error_of_estimate"].values()),
            vehicle_guess=max(vehicle["other_road_error_of_guess"].values()),
            squeezer_records=numbers["squeezer"]["records"],
            squeezer=covered(numbers["squeezer"]),
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(read()))
