"""README.md beside this file, made from page.md and cardona_geradin1989.json.

`python -m experiments.cardona_geradin1989.page`
"""

import json
from pathlib import Path

from experiments.page import find, table

HERE = Path(__file__).parent
HHT, TRAPEZOIDAL, DAMPED = "HHT, alpha = -0.1", "trapezoidal rule", "Newmark + damping"
NEEDED = 1e-3, 1e-5  # rad


def readings_table(entries):
    """What the trapezoidal rule does with each reading."""

    def span(x):
        return f"{x[0]:.1f} ... {x[1]:.1f}"

    rows = []
    for e in entries:
        spans = (span(e[f"ax_from_{start}_start_m_s2"]) for start in ("zero", "consistent"))
        rows.append([f"{e['v0_m_s']:g}", f"{e['h_s']:g}", f"{e['rise_m']:.3f}", f"{e['swing_m']:.3f}", *spans])
    header = ["v0 (m/s)", "h (s)", "rise (m)", "swing (m)", "acceleration from zero (m/s2)", "from consistent"]
    return "The trapezoidal rule in 1 s, by reading, with the horizontal acceleration from both starts:\n\n" + table(
        header, rows
    )


def tension_table(entries):
    """By method, start and time."""
    keys = [f"tension_error_near_{t}_s_N" for t in ("0.2", "1", "2")]
    rows = []
    for method in dict.fromkeys(e["method"] for e in entries):
        both = (find(entries, method=method, start=start) for start in ("zero", "consistent"))
        rows.append([method, *(f"{e[key]:.2g}" for e in both for key in keys)])
    times = "0.1-0.2 s", "0.9-1 s", "1.9-2 s"
    return table(["method", *(f"{start}, {t}" for start in ("zero", "consistent") for t in times)], rows)


def formulations_table(numbers):
    """Errors and times."""
    rows = []
    for e in numbers["entries"]:
        errors = ("-" if x is None else f"{x:.1e}" for x in e["position_error_m"])
        rows.append([e["formulation"], e["unknowns"], *errors, f"{e['time_over_angle']:.2f}"])
    return table(["formulation", "unknowns", *(f"h = {h:g} s" for h in numbers["step_sizes_s"]), "time"], rows)


def drift_table(entries):
    """First and last tenth."""
    keys = [f"{x}_{y}_tenth" for x in ("position", "rate") for y in ("first", "last")]
    rows = [[e["scene"], e["method"], *("-" if e[key] is None else f"{e[key]:.1e}" for key in keys)] for e in entries]
    return table(["scene", "method", "Phi, first", "Phi, last", "dPhi/dt, first", "dPhi/dt, last"], rows)


def mechanisms_table(entries):
    """Energy, violation, multipliers."""
    rows = []
    for e in entries:
        cells = (
            f"{e[key]:.1e}" for key in ("largest_energy_error_J", "largest_violation_m2", "largest_multiplier_N_m")
        )
        rows.append([e["formulation"], e["solve"], f"{e['h_s']:g}", *cells, "yes" if e["folded"] else "no"])
    header = ["formulation", "solve", "h (s)", "energy error (J)", "Phi (m2)", "largest multiplier (N/m)", "folded"]
    return table(header, rows)


def peaks_table(peaks):
    """n_max and the largest |D23| by alpha."""
    rows = [[alpha, *("-" if x is None else f"{x:.4g}" for x in row.values())] for alpha, row in peaks.items()]
    return table(["alpha", "n_max", "closed form", "largest D23", "relative deviation"], rows)


def top_table(entries):
    """Errors of place and acceleration."""
    rows = [[e["method"], f"{e['x_error_m']:.2e}", f"{e['ax_error_last_fifth_m_s2']:.2g}"] for e in entries]
    return table(["method", "x (m)", "acceleration in x, last 0.1 s (m/s2)"], rows)


def squeezer_table(entries):
    """Errors at both times."""
    rows = [[x if isinstance(x, str) else f"{x:.2g}" for x in e.values()] for e in entries]
    quantities = "q (rad)", "v (rad/s)", "acceleration (rad/s2)", "multipliers (N)"
    return table(["method", *(f"{x}{when}" for x in quantities for when in ("", ", 0.06 s"))], rows)


def bars_table(entries):
    """Errors of q at four steps."""
    sizes = 2e-4, 1e-4, 5e-5, 1e-5
    rows = []
    for method in dict.fromkeys(e["method"] for e in entries if "h_s" in e):
        errors = (find(entries, method=method, h_s=h)["q_error_rad"] for h in sizes)
        rows.append([method, *(f"{x:.1e}" for x in errors)])
    return table(["method", *(f"h = {h:.0e} s" for h in sizes)], rows)


def stops_table(entries):
    """Time per step and solves, by Newton's tolerance."""
    rows = []
    for e in entries:
        stop = "-" if e["newton_tolerance_N_m"] is None else f"{e['newton_tolerance_N_m']:.0e}"
        cells = f"{e['time_over_non_iterative']:.2f}", f"{e['cpu_time_per_step_us']:.1f}", f"{e['solves_per_step']:.2f}"
        rows.append([f"{e['method']}, {e['formulation']}", stop, *cells, f"{e['q_error_rad']:.2e}"])
    header = [
        "method",
        "tolerance (N m)",
        "time over non-iterative",
        "us per step",
        "solves per step",
        "error of q (rad)",
    ]
    return table(header, rows)


def needs_table(entries):
    """Least time, and solves of that run, for given errors."""
    rows = []
    for method in dict.fromkeys(e["method"] for e in entries):
        cells = []
        for limit in NEEDED:
            good = [e for e in entries if e["method"] == method and e["q_error_rad"] < limit]
            best = min(good, key=lambda e: e["cpu_time_s"], default=None)
            cells += ["-", "-"] if best is None else [f"{1e3 * best['cpu_time_s']:.3g}", best["solves"]]
        rows.append([method, *cells])
    return table(["method", *(f"{x}, {limit:.0e} rad" for limit in NEEDED for x in ("CPU time (ms)", "solves"))], rows)


def fastest(entries):
    """The method of the least time for each given error."""
    best = (
        (limit, min((e for e in entries if e["q_error_rad"] < limit), key=lambda e: e["cpu_time_s"]))
        for limit in NEEDED
    )
    return " and ".join(f"below {limit:.0e} rad {e['method']}" for limit, e in best)


def page(numbers):
    """The text of README.md."""
    pendulum, squeezer, work = (numbers[part] for part in ("pendulum", "squeezer", "work_precision"))
    reading = find(pendulum["readings"], v0_m_s=pendulum["v0_m_s"], h_s=pendulum["h_s"])
    other = find(pendulum["readings"], v0_m_s=1.505, h_s=pendulum["h_s"])
    key = "q_error_at_0.02_s_rad"
    hht, trapezoidal, damped = (find(squeezer["entries"], method=x)[key] for x in (HHT, TRAPEZOIDAL, DAMPED))
    stops = work["newton_tolerances"]
    ours = find(stops, method="non-iterative", formulation="ggl")
    theirs = find(stops, method="converged", formulation="index3", newton_tolerance_N_m=1e-10)
    calls = [find(work["entries"], method="index 1, DOP853", tolerance=1e-5)]
    calls += [find(work["entries"], method="index 1, RK4", h_s=5e-5)]
    by_python, compiled = (1e6 * e["cpu_time_s"] / e["solves"] for e in calls)
    loose = [e["time_over_non_iterative"] for e in stops if e["newton_tolerance_N_m"] == 1e-3]
    top = {e["method"].split(",")[0]: e for e in reversed(numbers["top"]["entries"])}
    orders = ([name, *(f"{order:.2f}" for order in by.values())] for name, by in work["orders"].items())
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=numbers["machine"],
            peaks=peaks_table(numbers["infinity"]["fig1"]),
            root_deviation=max(e["deviation_of_the_constraints_root"] for e in numbers["infinity"]["spectra"]),
            top_h=numbers["top"]["h_s"],
            top=top_table(numbers["top"]["entries"]),
            top_shaken=top["trapezoidal rule"]["ax_error_last_fifth_m_s2"],
            top_hht=top["HHT"]["x_error_m"],
            top_trapezoidal=top["trapezoidal rule"]["x_error_m"],
            top_newmark=top["Newmark + damping"]["x_error_m"],
            speed=pendulum["v0_m_s"],
            h=pendulum["h_s"],
            rise=reading["rise_m"],
            swing=reading["swing_m"],
            other_rise=other["rise_m"],
            other_swing=other["swing_m"],
            ax_low=reading["ax_from_zero_start_m_s2"][0],
            ax_high=reading["ax_from_zero_start_m_s2"][1],
            settled=find(pendulum["entries"], method="HHT, alpha = -0.05", start="zero")["tension_error_near_1_s_N"],
            readings=readings_table(pendulum["readings"]),
            tension=tension_table(pendulum["entries"]),
            formulations_alpha=numbers["formulations"]["alpha"],
            formulations=formulations_table(numbers["formulations"]),
            drift=drift_table(numbers["drift"]["entries"]),
            passages=numbers["mechanisms"]["entries"][-1]["passages"],
            mechanisms=mechanisms_table(numbers["mechanisms"]["entries"]),
            squeezer_h=squeezer["h_s"],
            moment=squeezer["moment_N_m"],
            squeezer=squeezer_table(squeezer["entries"]),
            hht=hht,
            newmark=damped,
            trapezoidal=trapezoidal,
            work_alpha=work["alpha"],
            bars=bars_table(work["entries"]),
            orders=table(["method", "q", "v", "multipliers"], orders),
            stops=stops_table(stops),
            ggl_over_index3=ours["cpu_time_per_step_us"] / theirs["cpu_time_per_step_us"],
            ggl_error_ratio=ours["q_error_rad"] / theirs["q_error_rad"],
            loose_low=min(loose),
            loose_high=max(loose),
            by_python=by_python,
            compiled=compiled,
            fastest=fastest(work["entries"]),
            needs=needs_table(work["entries"]),
            dae="" if work["scipy_dae"] else " scipy-dae was not installed.",
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "cardona_geradin1989.json").read_text())))
