"""README.md beside this file, made from page.md and sweeps.json.

`python -m experiments.sweeps.page`
"""

import json
from pathlib import Path

from experiments.page import find, table

HERE = Path(__file__).parent


def verdict(value, bar):
    """A row's last cells."""
    return f"{value:.3g}", "yes" if value <= bar else "**no**"


def bars_table(numbers):
    """What the issue asked for, what was measured, and whether it holds."""
    one, grid, devices, real = (numbers[part] for part in ("one_call", "map", "devices", "real_time"))
    beam = numbers["large"]["exponents"]["beam, banded"]
    paced = find(real["rows"], scene="double pendulum", form="at 1 kHz")
    rows = [
        ["31 step sizes, compilation over that of 31 calls", "<= 0.1", *verdict(one["compile_ratio"], 0.1)],
        ["the same, run over the sum", "<= 1.15", *verdict(one["run_ratio"], 1.15)],
        ["1e5 members, per member and step over C's batch", "<= 3", *verdict(grid["over_c"], 3)],
        ["the same, memory (MB)", "<= 1000", *verdict(grid["peak_MB"], 1000)],
        [
            "two processes, bitwise equal to one",
            "equal",
            *(["equal", "yes"] if devices["bitwise_equal"] else ["", "**no**"]),
        ],
        ["two processes, time over one's", "<= 0.65", *verdict(devices["over_one"]["two processes"], 0.65)],
        ["beam, exponent of time, forward", "<= 1.1", *verdict(beam["forward_us_per_step"], 1.1)],
        ["beam, exponent of time, gradient", "<= 1.1", *verdict(beam["gradient_us_per_step"], 1.1)],
        [f"1 kHz, deadlines missed in {real['calls']} calls", "0", *verdict(paced["deadlines_missed"], 0)],
        ["1 kHz step, median over an empty call", "<= 3", *verdict(real["median_over_empty_call"], 3)],
    ]
    return table(["what", "bar", "measured", "holds"], rows)


def orders_table(rows):
    """A row for each method, a column for each alpha."""
    alphas = sorted({row["alpha"] for row in rows if row["alpha"] is not None}, reverse=True)
    cells = []
    for method in dict.fromkeys(row["method"] for row in rows):
        found = {row["alpha"]: f"{row['order']:.2f}" for row in rows if row["method"] == method}
        cells.append([method, *(found.get(alpha, "") for alpha in alphas), found.get(None, "")])
    return table(["method", *(f"alpha = {alpha:g}" for alpha in alphas), "without alpha"], cells)


def real_time_table(rows):
    """Latencies."""
    header = ["scene", "h", "form", "median", "99.9 %", "worst", "over 1 ms"]
    keys = "median_us", "p999_us", "worst_us"
    cells = [
        [r["scene"], f"{r['h_s']:g} s", r["form"], *(f"{r[key]:.1f}" for key in keys), r["over_1_ms"]] for r in rows
    ]
    return table(header, cells)


def page(numbers):
    """The text of README.md."""
    one, orders, grid, devices = (numbers[part] for part in ("one_call", "orders", "map", "devices"))
    large, real = numbers["large"], numbers["real_time"]
    paced, idle = (
        find(real["rows"], scene="double pendulum", form=f"{of}at 1 kHz")["deadlines_missed"]
        for of in ("", "empty call ")
    )
    counted = [row for row in real["rows"] if "flops" in row]
    loop = real["hardware_in_the_loop"]
    middle = len(orders["stiffness"]["h_s"]) // 2
    biases = orders["stiffness"]["relative_error"]
    ns, bytes_per_member = grid["ns_per_member_and_step"], 8 * (3 * 2 * 3 + 3 + 1) + 13
    core_seconds = 1e8 * 2000 * ns * 1e-9
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=numbers["machine"],
            load=devices["load"],
            notes=numbers.get("notes", ""),
            bars=bars_table(numbers),
            members=one["members"],
            steps=one["steps"],
            difference=one["largest_difference_rad"],
            one_call=table(
                ["", "together", "separately", "ratio"],
                [
                    ["compilation (s)"]
                    + [f"{one[key]:.2f}" for key in ("compile_s", "compile_separately_s", "compile_ratio")],
                    ["run (s)"] + [f"{one[key]:.3f}" for key in ("run_s", "run_separately_s", "run_ratio")],
                ],
            ),
            orders=orders_table(orders["rows"]),
            k=20.0,
            h=orders["stiffness"]["h_s"][middle],
            biases=", ".join(f"{abs(x[middle]):.1e} ({name})" for name, x in biases.items()),
            map_members=grid["members"],
            alphas=len(grid["largest_h_s"]["alphas"]),
            scales=len(grid["largest_h_s"]["scales"]),
            mean_steps=grid["mean_steps"],
            run_s=grid["run_s"],
            ns=ns,
            over_c=grid["over_c"],
            c_ns=grid["c_ns_per_member_and_step"],
            peak=grid["peak_MB"],
            failed=grid["failed"] or "No",
            share_small=grid["share_with_error_below"]["0.0001"],
            share_large=grid["share_with_error_below"]["0.01"],
            device_members=devices["members"],
            equal="equal" if devices["bitwise_equal"] else "not equal",
            devices=table(
                ["", "s", "over one device"],
                [[name, f"{x:.2f}", f"{devices['over_one'][name]:.2f}"] for name, x in devices["seconds"].items()],
            ),
            cores=numbers["machine"].split()[0],
            bytes_per_member=bytes_per_member,
            core_hours=core_seconds / 3600,
            seconds=core_seconds / 1000,
            gigabytes=1e8 * bytes_per_member / 1e9,
            gathering=1e8 * bytes_per_member / 1e9,
            exponents=table(
                ["", "time", "time of the gradient", "memory", "memory of the gradient"],
                [[name, *(f"{x:.2f}" for x in found.values())] for name, found in large["exponents"].items()],
            ),
            left=table(
                ["iterations", *(f"n = {n}" for n in large["left"])],
                [
                    [rows[0]["iterations"], *(f"{row['error']:.1e}" for row in rows)]
                    for rows in zip(*large["left"].values(), strict=True)
                ],
            ),
            courant=4.0,
            calls=real["calls"],
            real_time=real_time_table(real["rows"]),
            deadlines=f"At 1 kHz, {paced} deadlines were missed in {real['calls']} calls, {idle} by the empty call.",
            flops=", ".join(
                f"{row['flops']:.0f} floating-point operations ({row['scene']}), {row['while_loops']} loops"
                for row in counted
            ),
            loop_steps=loop["steps"],
            late=loop["late"],
            stale=loop["stale_commands"],
            end=loop["end_rad"],
            target=loop["target_rad"],
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "sweeps.json").read_text())))
