"""README.md beside this file, made from page.md and the numbers of ten experiments.

`python -m experiments.identification.page`
"""

import json
from pathlib import Path

import numpy as np

from experiments.page import find, table

HERE = Path(__file__).parent
SHOWN = ("non-iterative, alpha = 0", "non-iterative, alpha = -0.3", "converged, alpha = 0", "Kim's step, alpha = 0")
STEPS = 0.04, 0.01, 0.0025  # s
MEASURED = (
    "silverbox", "silverbox_comparison", "silverbox_terms", "double_pendulum_measured", "bouc_wen", "emps", "tanks",
)  # fmt: skip
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
            ["fit", "k/m", "c/m"], [[n, *(f"{by[x]:.1e}" for x in ("k/m", "c/m"))] for n, by in agreement.items()]
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
    return table(["solver", *far], rows)


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
    header = ["model", "parameters", "training", "left out", "behind the best (standard errors)", "test"]
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


def terms_pieces(numbers):
    """What was added to Silverbox's model, and what the score tests said."""
    errors = {"train_mV": "training", "left_out_mV": "left out", "arrow_full_mV": "arrow, full"}
    errors |= {"arrow_no_extrapolation_mV": "arrow, no extrapolation", "multisine_mV": "multisine"}
    rows = [
        [row["model"] + ", kept" * row["kept"], row["parameters"], *(f"{row[key]:.4f} mV" for key in errors)]
        for row in numbers["models"]
    ]
    tests = [
        ", ".join(f"{n} {x['cost_drop_percent']:.1f}" for n, x in found.items()) for found in numbers["score_tests"]
    ]
    last = [row for row in numbers["models"] if row["kept"]][-1]
    return {
        "terms": table(["model", "parameters", *errors.values()], rows),
        "terms_first_score": tests[0],
        "terms_second_score": tests[1],
        "terms_parts": numbers["parts"],
        "terms_lag_us": -1e6 * 0.2**2 * last["estimates"]["amplitude_lag"],
        "terms_arrow": last["arrow_full_mV"],
        "terms_relaxing": find(numbers["models"], model="+ relaxing_cubic")["arrow_full_mV"],
        "terms_candidates": len(numbers["score_tests"][0]),
    }


def tanks_pieces(numbers):
    """Models of the cascaded tanks, and the estimates of the one chosen."""
    rows = [
        [row["model"], row["parameters"], *(f"{row[f'{part}_V']:.3f} V" for part in ("train", "left_out", "test"))]
        for row in numbers["models"]
    ]
    bounds = numbers["interval_95"]
    estimates = [
        [name, f"{value:.4g}", f"{bounds[name][0]:.4g} to {bounds[name][1]:.4g}", unit.replace("_", " ")]
        for (name, unit), value in ((key.split("_in_"), x) for key, x in numbers["estimates"].items())
    ]
    return {
        "tanks": table(["term added", "parameters", "training", "left out", "test"], rows),
        "tanks_estimates": table(["parameter", "estimate", "95 % interval", "unit"], estimates),
        "tanks_chosen": numbers["chosen"],
        "tanks_test": numbers["test_V"],
        "tanks_own_start": numbers["test_from_its_first_samples_V"],
        "tanks_finest": list(numbers["test_by_steps_in_a_sample_V"].values())[-1],
        "tanks_others": ", ".join(f"{x:g} V ({name})" for name, x in numbers["published_test_V"].items()),
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
            **terms_pieces(numbers["silverbox_terms"]),
            **tanks_pieces(numbers["tanks"]),
            stiff_records=stiff["records"],
            stiff_converged=stiff["converged"],
            stiff_cost=stiff["largest_cost_per_residual"],
            stiff_seconds=stiff["fit_time_s"],
            stiff_cold=stiff["fit_with_compilation_s"],
            stiff_covered=stiff["covered"]["Richardson"]["k1"],
            stiff_covered_h=stiff["covered"]["h"]["k1"],
            arrow_mV=numbers["silverbox"]["models"]["10 parameters"]["arrow_full_mV"],
            machine="{processor}, {cores} cores, jax {jax}".format(**numbers["stiff_joint"]["made_by"]),
            stiff_k2=stiff["determined"]["k2"],
            stiff=covered(stiff),
            gradients=gradients_table(gradients),
            diffrax=f"diffrax's Kvaerno5 with a tolerance of 1e-6 and its default adjoint takes "
            f"{1e3 * theirs['seconds']:.0f} ms for an error of {theirs['relative_error']:.1e}. The non-iterative step "
            f"takes {1e3 * ours['seconds']:.1f} ms for {ours['relative_error']:.1e}. Both times are warm.",
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
