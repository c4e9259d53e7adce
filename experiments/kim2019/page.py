"""README.md beside this file, made from page.md and kim2019.json: `python -m experiments.kim2019.page`."""

import json
from pathlib import Path

from experiments.page import find, table

HERE = Path(__file__).parent


def rms_table(name, entries):
    """Ours, printed, difference."""
    rows = []
    for e in entries:
        printed = f"{e['printed_rad']:.4e}"
        if e["misprint"]:
            printed = f"**{printed}** [{e['read_as_rad']:.4e}]"
        off = e["reference_error_rad"]
        last = f"reference error {off:.2e}" if off else f"{100 * e['relative_difference']:+.2f} %"
        rows.append([f"{e['h_s']:g}", e["angle"], e["method"], f"{e['ours_rad']:.4e}", printed, last])
    return f"**{name}**\n\n" + table(["h (s)", "angle", "method", "ours", "printed", "difference"], rows)


def overview(numbers):
    """The numbers of the first table."""
    stability, tables = numbers["stability"]["methods"], numbers["tables"]
    entries = tables["Table 2"] + tables["Table 5"]
    clear = [e for e in entries if not e["reference_error_rad"]]
    times = {
        f"time_{scene}_{method}": ratios["time_over_implicit_euler"]
        for scene, methods in numbers["timing"]["summary"].items()
        for method, ratios in methods.items()
    }
    return times | {
        "unstable": stability["non-iterative HHT, alpha = -0.3"]["unstable_on_real_axis_until"],
        "unstable_converged": stability["conventional HHT, alpha = -0.3"]["unstable_on_real_axis_until"],
        "closed_form": max(m["deviation_of_spectral_radius"] for m in stability.values()),
        "factor": find(numbers["linear"]["damped"], h_s=0.1, alpha=0.0)["factor_per_step"],
        "clear": len(clear),
        "close": 100 * max(abs(e["relative_difference"]) for e in clear),
        "misprints": sum(bool(e["misprint"]) for e in entries),
        "limited": len(entries) - len(clear),
        "reproduced": tables["largest_deviation_from_reproduced"],
    }


def orders_table(entries):
    """Order by method and case, and after the arrow the order of the remainder."""
    cases = list(dict.fromkeys(e["case"] for e in entries))
    rows = []
    for method in dict.fromkeys(e["method"] for e in entries):
        cells = []
        for case in cases:
            e = find(entries, case=case, method=method)
            rest = f" -> {e['order_after_subtracting_the_modified_motion']:.2f}"
            cells.append(f"{e['order']:.2f}{rest if e['error_over_predicted_at_finest'] else ''}")
        rows.append([method, *cells])
    return table(["method", *cases], rows)


def repaired_table(numbers):
    """Ratios at four step sizes."""
    sizes = numbers["step_sizes_s"]
    shown = [sizes.index(h) for h in (1e-4, 1e-3, 1e-2, 1e-1)]
    rows = []
    for e in numbers["entries"]:
        if e["method"] != "converged" and e["alpha"] != -0.1:
            ratios = (f"{e['error_over_converged'][i]:.3g}" for i in shown)
            rows.append([e["scene"], f"{e['alpha']:g}", e["method"], f"{e['order']:.2f}", *ratios])
    return table(["pendulum", "alpha", "method", "order", "h = 1e-4", "1e-3", "1e-2", "1e-1 s"], rows)


def timing_table(numbers):
    """Time, iterations, and error times time, over implicit Euler's."""
    rows = []
    for scene in ("stiff", "free"):
        for method in numbers["summary"][scene]:
            cells = []
            for h in (1e-3, 1e-1):
                e, euler = (find(numbers["entries"], scene=scene, method=m, h_s=h) for m in (method, "implicit Euler"))
                cells += [
                    f"{e['time_per_step_s'] / euler['time_per_step_s']:.2f}",
                    f"{e['iterations_per_step']:.2f}",
                    f"{e['error_times_time_rad_s'] / euler['error_times_time_rad_s']:.2g}",
                ]
            rows.append([scene, method, *cells])
    header = ["pendulum", "method"] + [
        f"{x}, h = {h}" for h in ("1e-3", "1e-1") for x in ("time", "iterations", "error x time")
    ]
    return (
        "Warm time per step, and error times time, over implicit Euler's in the same run, with alpha = 0:\n\n"
        + table(header, rows)
    )


def splitting_table(numbers):
    """Orders and largest bounded steps."""
    rows = []
    for name, slopes in numbers["slopes"].items():
        bounded = numbers["largest_bounded_h_s"][name]
        rows.append([name, *(f"{x:.2f}" for x in slopes), *(f"{1e3 * x:.3g}" if x else "none" for x in bounded)])
    alphas = [f"{alpha:g}" for alpha in numbers["alphas"]]
    header = ["scene, method", *(f"order, alpha = {x}" for x in alphas), *(f"bounded h (ms), {x}" for x in alphas)]
    return table(header, rows)


def limits_table(numbers):
    """Of the hardening spring."""
    rows = []
    for name, limit in numbers["hardening_spring_limit_s"].items():
        both = limit["measured"], limit["predicted"]
        rows.append([name, *("all" if x is None else f"{1e3 * x:.1f}" if x else "none" for x in both)])
    return table(["start", "measured", "predicted"], rows)


def vehicle_table(numbers):
    """Largest step below 1 mm, and its speed."""
    rows = []
    for method, m in numbers["methods"].items():
        h = m["largest_h_below_1_mm_s"]
        cells = ["-"] * 4
        if h is not None:
            cells = [f"{1e3 * h:g}", f"{m['error_at_it_mm']:.2f}", f"{m['us_per_step_at_it']:.2f}"]
            cells.append(f"{m['real_time_factor_at_it']:.0f}")
        rows.append([method, *cells, f"{m['slope']:.2f}"])
    header = ["method", "largest h below 1 mm (ms)", "error (mm)", "us per step", "times real time", "order"]
    return table(header, rows)


def arm_table(numbers):
    """Errors at the coarsest and the finest step, and order."""
    ends = [1e3 * numbers["step_sizes_s"][i] for i in (0, -1)]
    header = ["method", *(f"RMS error (rad), h = {h:.3g} ms" for h in ends), "order", "us per step"]
    rows = []
    for e in numbers["entries"]:
        errors = (f"{e['rms_error_rad'][i]:.2e}" for i in (0, -1))
        rows.append([e["method"], *errors, f"{e['observed_orders'][-1]:.2f}", f"{1e6 * e['time_per_step_s']:.2f}"])
    return table(header, rows)


def page(numbers):
    """The text of README.md."""
    kim, hht = (find(numbers["linear"]["oscillator"], method=m, alpha=-0.05) for m in ("Kim's step", "hht"))
    damping = "damping_ratio_at_wh_0.1"
    alphas, arm = numbers["alpha"]["alpha"], numbers["arm"]
    compile_s = arm["compile_M_and_Q_s"]
    largest = [max(entry["deviation"][i] for entry in numbers["alpha"]["entries"]) for i in range(len(alphas))]
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            **overview(numbers),
            machine=numbers["machine"],
            tables="\n\n".join(rms_table(name, numbers["tables"][name]) for name in ("Table 2", "Table 5")),
            kim_damping=kim[damping],
            hht_damping=hht[damping],
            damping_ratio=kim[damping] / hht[damping],
            at_zero=100 * largest[alphas.index(0.0)],
            at_hundredth=100 * largest[alphas.index(-0.01)],
            orders=orders_table(numbers["order"]["entries"]),
            repaired=repaired_table(numbers["repaired"]),
            timing=timing_table(numbers["timing"]),
            splitting=splitting_table(numbers["splitting"]),
            limits=limits_table(numbers["splitting"]),
            vehicle=vehicle_table(numbers["vehicle"]),
            arm=arm_table(arm),
            arm_M=arm["M_relative_difference"],
            arm_Q=arm["Q_relative_difference"],
            arm_run=arm["run_relative_difference"],
            arm_step=arm["lagrange_step_time_ratio"],
            arm_compile=compile_s["Lagrange"] / compile_s["Newton-Euler"],
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "kim2019.json").read_text())))
