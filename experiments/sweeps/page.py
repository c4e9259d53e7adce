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
    """What was aimed at, what was measured, and whether it holds."""
    one, grid, devices, real = (numbers[part] for part in ("one_call", "map", "devices", "real_time"))
    beam = numbers["large"]["exponents"]["beam, banded"]
    paced = find(real["rows"], scene="double pendulum", form="at 1 kHz")
    rows = [
        ["31 step sizes in one call, compilation over that of 31 calls", "<= 0.1", *verdict(one["compile_ratio"], 0.1)],
        ["31 step sizes in one call, run over the sum of 31 runs", "<= 1.15", *verdict(one["run_ratio"], 1.15)],
        ["1e5 members, time per member and step over the C batch", "<= 3", *verdict(grid["over_c"], 3)],
        ["1e5 members, memory (MB)", "<= 1000", *verdict(grid["peak_MB"], 1000)],
        [
            "two processes, bitwise equal to one",
            "equal",
            *is_equal(devices["bitwise_equal"]),
        ],
        ["two processes, time over that of one", "<= 0.65", *verdict(devices["over_one"]["two processes"], 0.65)],
        *worker_bars(numbers["workers"]),
        ["beam, exponent of time, forward", "<= 1.1", *verdict(beam["forward_us_per_step"], 1.1)],
        ["beam, exponent of time, gradient", "<= 1.1", *verdict(beam["gradient_us_per_step"], 1.1)],
        [f"1 kHz, deadlines missed in {real['calls']} calls", "0", *verdict(paced["deadlines_missed"], 0)],
        ["1 kHz step, median time over an empty call", "<= 3", *verdict(real["median_over_empty_call"], 3)],
    ]
    return table(["quantity", "target", "measured", "met"], rows)


def worker_bars(numbers):
    """Of workers that are handed chunks."""
    rows, memory = numbers["rows"], numbers["memory_MB"]
    small, large = (memory[key] for key in sorted(memory, key=int))
    two = [name for name in rows if name.endswith(", 2")]
    compiled = max(max(rows[name]["compiled_by_each"]) for name in two)
    killed = " and ".join(f"{x['kills']} {name}" for name, x in numbers["killed"].items()) + " killed"
    whole = all(x["equal"] for x in numbers["killed"].values())
    return [
        *([f"{name} workers, time over that of one", "<= 0.55", *verdict(over_one(rows, name), 0.55)] for name in two),
        ["programs that a worker compiles", "1", *verdict(compiled, 1)],
        ["workers, bitwise equal to one process", "equal", *is_equal(numbers["bitwise_equal"])],
        [f"{killed}, files equal", "equal", *is_equal(whole)],
        ["1e6 members, the caller's memory over that of 1e5", "<= 1.5", *verdict(large / small, 1.5)],
    ]


def is_equal(value):
    """A row's last cells."""
    return ["equal", "yes"] if value else ["differ", "**no**"]


def over_one(rows, name):
    """The time of two workers over that of one."""
    return rows[name]["seconds"] / rows[name.replace("2", "1")]["seconds"]


def workers_table(numbers):
    """Who worked, and what it took."""
    rows, alone = numbers["rows"], numbers["rows"]["none"]["seconds"]
    cells = []
    for name, x in rows.items():
        more = [f"{x[key] * unit:.3g}" if key in x else "" for key, unit in (("first_s", 1), ("task_s", 1e3))]
        who = "none: this process" if name == "none" else name
        cells.append([who, f"{x['seconds']:.1f}", f"{x['seconds'] / alone:.2f}", *more])
    return table(["workers", "warm (s)", "ratio to no workers", "cold, one file each (s)", "empty task (ms)"], cells)


def queue_table(numbers):
    """Shares of time in which workers work."""
    header = ["workers", *(f"{x:g} s" for x in numbers["seconds"]), "repeated"]
    cells = [[n, *(f"{x:.2f}" for x in shares), numbers["done_again"][n]] for n, shares in numbers["share"].items()]
    return table(header, cells)


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
    header = ["scene", "h", "form", "median (us)", "99.9 % (us)", "worst (us)", "calls over 1 ms"]
    keys = "median_us", "p999_us", "worst_us"
    cells = [
        [r["scene"], f"{r['h_s']:g} s", r["form"], *(f"{r[key]:.1f}" for key in keys), r["over_1_ms"]] for r in rows
    ]
    return table(header, cells)


def page(numbers):
    """The text of README.md."""
    one, orders, grid, devices = (numbers[part] for part in ("one_call", "orders", "map", "devices"))
    large, real, fit = numbers["large"], numbers["real_time"], numbers["workers"]["fit"]
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
            compile_together=one["compile_s"],
            compile_apart=one["compile_separately_s"],
            worker_ratio=over_one(numbers["workers"]["rows"], "processes, 2"),
            paced=paced,
            idle=idle,
            steps=one["steps"],
            difference=one["largest_difference_rad"],
            one_call=table(
                ["time", "one call", "separate calls", "ratio"],
                [
                    ["compilation, cold (s)"]
                    + [f"{one[key]:.2f}" for key in ("compile_s", "compile_separately_s", "compile_ratio")],
                    ["run, warm (s)"] + [f"{one[key]:.3f}" for key in ("run_s", "run_separately_s", "run_ratio")],
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
                ["devices", "s", "over one device"],
                [[name, f"{x:.2f}", f"{devices['over_one'][name]:.2f}"] for name, x in devices["seconds"].items()],
            ),
            worker_members=numbers["workers"]["members"],
            worker_chunk=numbers["workers"]["chunk"],
            worker_steps=numbers["workers"]["steps"],
            fit_records=fit["records"],
            fit_samples=fit["samples"],
            fit_alone=fit["alone_s"],
            fit_shared=fit["two_workers_s"],
            fit_iterations=fit["iterations"],
            fit_iterations_shared=fit["iterations_shared"],
            fit_apart=fit["apart_in_standard_errors"],
            fit_triangles=fit["bytes_of_triangles"] / 1e3,
            fit_rows=fit["bytes_of_rows"] / 1e6,
            workers=workers_table(numbers["workers"]),
            blob=numbers["workers"]["bytes"] / 1e3,
            blob_rate=100 * numbers["workers"]["bytes"] / 1e6,
            kills="; ".join(f"{x['kills']} {name}" for name, x in numbers["workers"]["killed"].items()),
            memory=", ".join(
                f"{x:.0f} MB ({float(n):.0e} members)" for n, x in numbers["workers"]["memory_MB"].items()
            ),
            compiling_hours=1000 * numbers["on_paper"]["compiling_s"] / 3600,
            queue=queue_table(numbers["on_paper"]),
            task_ms=numbers["on_paper"]["task_s"] * 1e3,
            compiling=numbers["on_paper"]["compiling_s"],
            rounds=numbers["on_paper"]["rounds"],
            cores=numbers["machine"].split()[0],
            bytes_per_member=bytes_per_member,
            core_hours=core_seconds / 3600,
            seconds=core_seconds / 1000,
            gigabytes=1e8 * bytes_per_member / 1e9,
            gathering=1e8 * bytes_per_member / 1e9,
            exponents=table(
                ["system", "time", "time, gradient", "memory", "memory, gradient"],
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
            deadlines=f"At 1 kHz the step missed {paced} deadlines in {real['calls']} calls, the empty call {idle}.",
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
