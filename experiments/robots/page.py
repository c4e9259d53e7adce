"""README.md beside this file, made from page.md and robots.json.

`python -m experiments.robots.page`
"""

import json
from pathlib import Path

from experiments.page import table
from experiments.robots.accuracy import LATE, SAME, TARGETS, reached

HERE = Path(__file__).parent
STEP = 0.02  # s, at which something was aimed at
PACKAGES = "hhtjax", "jax", "mujoco", "exudyn", "dm_control"


def usable(rows: dict) -> dict:
    """Rows with None for what is infinite, as JSON has it."""
    return {key: [float("inf") if x is None and "error" in key else x for x in values] for key, values in rows.items()}


def milliseconds(x) -> str:
    """To two digits."""
    return "-" if x is None else f"{1e3 * x:.2g}" if 1e3 * x < 100 else f"{1e3 * x:.0f}"


def cell(rows: dict, target: float) -> str:
    """Step / time of a run."""
    found = reached(usable(rows), target)
    if found is None:
        return "-"
    edge = ">" if found["on_edge"] else ""
    return f"{edge}{milliseconds(found['h_s'])} / {milliseconds(found['time_s'])}"


def tables_of(cases) -> str:
    """One for each case; variants of ours, which are not timed, have theirs below."""
    parts = []
    for case in cases:
        rows = [
            [name, *(cell(x, target) for target in TARGETS)]
            for name, x in case["methods"].items()
            if x["time_s"][0] is not None
        ]
        parts += [f"**{case['case']}**, n = {case['n']}, {case['duration_s']:g} s", ""]
        parts += [table(["method", *(f"{target:.0e} rad" for target in TARGETS)], rows), ""]
    return "\n".join(parts).strip()


def at_step(rows: dict, key: str, style: str = ".1e") -> str:
    """The value of a run with steps of 20 ms."""
    value = rows[key][rows["h_s"].index(STEP)]
    return "lost" if value is None or value > 10 else f"{value:{style}}"


def largest(rows: dict, target: float, key: str) -> str:
    """The largest step within an error, ms."""
    found = reached(usable(rows), target, key)
    return "-" if found is None else f"{'>' if found['on_edge'] else ''}{milliseconds(found['h_s'])}"


def rigid(cases) -> str:
    """All methods on the arm."""
    rows = []
    for case in cases:
        for name, x in case["methods"].items():
            cells = [(at_step(x, key), largest(x, 1e-4, key)) for key in ("error_rad", "late_error_rad")]
            rows.append([short(case), name, *(y for pair in cells for y in pair)])
    late = f"from {LATE:g} s on"
    header = ["case", "method", "error at 20 ms", "1e-4 up to (ms)", f"error {late}", f"1e-4 {late} up to (ms)"]
    return table(header, rows)


def verdicts(cases, key: str, aim: float) -> str:
    """What a table says of what was aimed at: this value of ours, with steps of 20 ms."""
    lines = []
    for case in cases:
        rows = case["methods"]["hht"]
        value = rows[key][rows["h_s"].index(STEP)]
        met = value is not None and value <= aim
        lines.append(f"{'reached' if met else 'missed'} with {short(case)}")
    return f"With the default `hht()` the target is {'; '.join(lines)}."


def short(case) -> str:
    """What a case is, without the mechanism."""
    return case["case"].removeprefix("UR5 on servos, ").removeprefix("flexible joints, ")


def flexible(cases) -> str:
    """Torques at 20 ms, and the largest step within 1 %."""
    rows = []
    for case in cases:
        for name, x in case["methods"].items():
            torques = [percent(x[key][x["h_s"].index(STEP)]) for key in ("torque_error", "late_torque_error")]
            steps = [largest(x, 0.01, key) for key in ("torque_error", "late_torque_error")]
            rows.append([short(case), name, *torques, *steps])
    late = f"from {LATE:g} s on"
    header = ["case", "method", "error at 20 ms", f"error {late}", "1 % up to (ms)", f"1 % {late} up to (ms)"]
    return table(header, rows)


def percent(x) -> str:
    """Of the largest torque; lost from ten times that on."""
    return "lost" if x is None or x > 10 else f"{100 * x:.2g} %" if x < 0.995 else f"{100 * x:.0f} %"


def step_times(found: dict) -> str:
    """A row for each case."""
    methods = list(next(iter(found.values())))
    rows = []
    for case, values in found.items():
        cells = [f"{values[m]['us']:.3g}" + bracket(values[m]) for m in methods]
        rows.append([case, *cells])
    return table(["case, us", *(m if m == "hht" else f"MuJoCo {m}" for m in methods)], rows)


def bracket(values: dict) -> str:
    """The ratio, where there is one."""
    ratio = values.get("over_implicitfast")
    return "" if ratio is None else f" ({ratio:.2f})"


def row_of_loops(found: dict) -> str:
    """By bodies, in natural coordinates, and by MuJoCo."""
    rows = [
        [
            "`hhtjax.bodies`", f"{found['us_a_step']:.0f}", f"{found['first_cpu_s']:.0f}",
            f"{found['error_rad']:.1e}", f"{found['gap_m']:.1e}",
        ],
        [
            "natural coordinates, `scenes.four_bars`", f"{found['natural_us_a_step']:.0f}",
            f"{found['natural_first_cpu_s']:.0f}", "", "",
        ],
    ]  # fmt: skip
    if found["mujoco_us_a_step"] is not None:
        name = "MuJoCo implicitfast, soft loops"
        rows.append([name, f"{found['mujoco_us_a_step']:.0f}", "", f"{found['mujoco_error_rad']:.1e}", ""])
    return table(["model", "us per step", "first call (CPU s)", "error (rad)", "largest gap (m)"], rows)


def humanoids(found: dict) -> str:
    """A table, or why there is none."""
    if "skipped" in found:
        return f"Not run: {found['skipped']}."
    rows = [
        [
            name, x["rates"], f"{x['us_a_step']:.0f}", f"{x['cpu_us_a_step']:.0f}", f"{x['mujoco_us_a_step']:.0f}",
            f"{x['us_a_step'] / x['mujoco_us_a_step']:.0f}", f"{x['first_cpu_s']:.0f}", "yes" if x["finite"] else "no",
        ]
        for name, x in found["models"].items()
    ]  # fmt: skip
    words = (
        f"Models of dm_control {found['dm_control']} fall in steps of 2 ms, without contact, motors, dry friction and "
        "joint ranges in both programs. Step times are warm, first calls cold."
    )
    header = [
        "model",
        "velocities",
        "us per step",
        "CPU us per step",
        "MuJoCo implicitfast (us)",
        "ratio",
        "first call (CPU s)",
        "finite",
    ]
    return f"{words}\n\n{table(header, rows)}"


def fastest(case, method: str) -> str:
    """The least time to 1e-4 rad of the methods that begin so, ms."""
    found = (reached(usable(x), 1e-4) for name, x in case["methods"].items() if name.startswith(method))
    return milliseconds(min((x["time_s"] for x in found if x and x["time_s"] is not None), default=None))


def humanoid_ratio(found: dict) -> str:
    """Of our steps to MuJoCo's, from the least to the largest."""
    ratios = [x["us_a_step"] / x["mujoco_us_a_step"] for x in found.get("models", {}).values()]
    return f"{min(ratios):.0f} to {max(ratios):.0f}" if ratios else "(not measured)"


def page(numbers):
    """The text of README.md."""
    accuracy, costs, loops = numbers["accuracy"], numbers["costs"], numbers["loops"]
    cases, gradient, made_by = accuracy["cases"], costs["gradient"], numbers["made_by"]
    closed = next(case for case in cases if "gap_m" in case)
    arms = [case for case in cases if case["case"].startswith("UR5")]
    elastic = [case for case in cases if case["case"].startswith("flexible")]
    peers = [name for name, found in accuracy["installed"].items() if found]
    known = made_by | {"dm_control": numbers["humanoids"].get("dm_control")}
    missing = [name for name, found in accuracy["installed"].items() if not found]
    versions = ", ".join(f"{name} {known[name]}" for name in PACKAGES if known.get(name)) + "."
    agreement = {
        name: max(case["accelerations"][name] for case in cases if name in case["accelerations"]) for name in peers
    }
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=numbers["machine"],
            arm_hht=fastest(arms[0], "hht"),
            arm_mujoco=fastest(arms[0], "MuJoCo"),
            chain_hht=fastest(cases[-1], "hht"),
            chain_mujoco=fastest(cases[-1], "MuJoCo"),
            humanoid_ratio=humanoid_ratio(numbers["humanoids"]),
            load=made_by["load_at_end"],
            versions=versions + "".join(f" {name} was not installed." for name in missing),
            same=SAME,
            agreement=" and ".join(f"{x:.0e} ({name})" for name, x in agreement.items()) or "not measured",
            sample=1e3 * accuracy["sample_s"],
            reference=f"{max((case['reference_error'] or 0) for case in cases):.0e}",
            reached=tables_of(cases),
            late=LATE,
            rigid=rigid(arms),
            rigid_words=verdicts(arms, "error_rad", 1e-4),
            flexible=flexible(elastic),
            flexible_words=verdicts(elastic, "torque_error", 0.01),
            gap=closed["gap_m"],
            gap_dt=1e3 * closed["gap_dt_s"],
            gap_duration=closed["duration_s"],
            explained=closed["loop_over_steps"],
            turned=loops["turned_rad"],
            made=loops["made_cpu_s"],
            row_of_loops=row_of_loops(loops),
            loops_dt=1e3 * loops["dt_s"],
            **{key: loops[key] for key in ("loops", "rows", "coordinates", "rank", "rows_kept")},
            step_times=step_times(costs["step_times"]),
            parameters=gradient["parameters"],
            names=", ".join(gradient["names"]),
            gradient_case=gradient["case"],
            ratio=gradient["ratio"],
            gradient_us=gradient["gradient_us_a_step"],
            run_us=gradient["run_us_a_step"],
            gradient_first=gradient["gradient_first_cpu_s"],
            run_first=gradient["run_first_cpu_s"],
            humanoids=humanoids(numbers["humanoids"]),
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "robots.json").read_text())))
