"""README.md beside this file, made from page.md and export.json.

`python -m experiments.export.page`
"""

import json
from pathlib import Path

from experiments.page import busy, find, table

HERE = Path(__file__).parent


def verdict(value, bar):
    """A row's last cells."""
    return f"{value:.3g}", yes_or_no(value <= bar)


def yes_or_no(holds):
    """Whether a bar holds."""
    return "yes" if holds else "**no**"


def bars_table(numbers):
    """What was asked for, what was measured, and whether it holds."""
    speed, fitted = numbers["speed"], numbers["pendulum"]
    slowest = max(row["c_time_over_xla"] for row in speed["scenes"])
    rows = [
        [
            f"difference of C and Python after {fitted['num_steps']} steps (rad)",
            "<= 1e-12",
            *verdict(fitted["difference_rad"], 1e-12),
        ],
        ["time of a step over C written by hand", "<= 1.1", *verdict(speed["time_over_by_hand"], 1.1)],
        ["time of a step over XLA, worst scene", "<= 1.5", *verdict(slowest, 1.5)],
    ]
    for rate, chance in numbers["real_time"]["chance_of_not_explained"].items():
        own, waits = (
            find(numbers["real_time"]["deadlines"], rate=rate, form=form)["not_explained_count"]
            for form in ("step", "waits as long")
        )
        rows.append(
            [
                f"unexplained missed deadlines at {rate}",
                f"as the waiting loop ({waits}); chance >= 5 %",
                f"{own}; chance {100 * chance:.0f} %",
                yes_or_no(chance >= 0.05),
            ]
        )
    return table(["quantity", "target", "measured", "met"], rows)


def deadlines_table(rows):
    """Deadlines missed, by causes, and latencies after the due time."""
    causes = "woke_too_late_count", "interrupted_count", "not_explained_count"
    keys = "own_us", "median_us", "worst_us", "longest_step_us"
    cells = []
    for r in rows:
        times = ["-" if r.get(key) is None else f"{r[key]:.1f}" for key in keys]
        cells.append([r["rate"], r["form"], r["calls"], r["missed_count"], *(r.get(x, "-") for x in causes), *times])
    header = ["rate", "form", "periods", "missed", "woke too late", "interrupted", "not explained"]
    header += ["own time, 99.9 % (µs)", "median end (µs)", "worst end (µs)", "longest (µs)"]
    return table(header, cells)


def page(numbers):
    """The text of README.md."""
    machine, fitted, speed, real = (numbers[part] for part in ("machine", "pendulum", "speed", "real_time"))
    awake = [find(real["deadlines"], rate=rate, form="empty loop")["usually_awake_us"] for rate in ("1 kHz", "10 kHz")]
    errors = {key: max(map(abs, values)) for key, values in fitted["relative_error_of"].items()}
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=(
                f"{machine['processor']}, {machine['cores']} cores, with a load of {machine['load_at_start']:.1f}"
                f"{busy(machine)}; jax {machine['jax']}, {machine['compiler']}. Everything is in float64."
            ),
            deadline_words=" ".join(
                f"At {r['rate']} the step misses {r['missed_count']} of {r['calls']} deadlines; "
                f"{r['not_explained_count']} of these are unexplained."
                for r in real["deadlines"]
                if r["form"] == "step"
            ),
            over_hand=speed["time_over_by_hand"],
            over_xla=max(row["c_time_over_xla"] for row in speed["scenes"]),
            bars=bars_table(numbers),
            samples=2 * fitted["num_samples"],
            noise=1e3 * fitted["noise_rad"],
            k_error=errors["k"],
            c_error=errors["c"],
            lines=fitted["lines"],
            operations=fitted["operations"],
            functions=fitted["functions"],
            steps=fitted["num_steps"],
            difference=fitted["difference_rad"],
            load=speed["load_at_start"],
            flags=f"`{speed['flags']}`",
            by_hand=table(["form", "ns per step"], [[k, f"{x:.1f}"] for k, x in speed["by_hand_ns"].items()]),
            scenes=table(
                ["scene", "operations", "sines etc.", "C (ns)", "XLA (ns)", "C over XLA", "difference"],
                [
                    [r["scene"], r["operations"], r["functions"], f"{r['c_ns']:.0f}", f"{r['xla_ns']:.0f}",
                     f"{r['c_time_over_xla']:.2f}", f"{r['relative_difference']:.0e}"]
                    for r in speed["scenes"]
                ],
            ),
            policy=(
                "The loops run with real-time scheduling (`SCHED_FIFO`) and locked memory; Python does not."
                if real["real_time_scheduling"]
                else "The operating system gave the loops no real-time scheduling."
            ),
            deadlines=deadlines_table(real["deadlines"]),
            real_load=real["load_at_start"],
            awake=" and ".join(f"{x:.0f}" for x in awake),
            calls=real["back_to_back"][0]["calls"],
            back_to_back=table(
                ["form", "median (ns)", "99.9999 % (ns)", "worst (ns)", "worst over median"],
                [
                    [r["form"], r["median_ns"], r["p999999_ns"], r["worst_ns"], f"{r['worst_time_over_median']:.0f}"]
                    for r in real["back_to_back"]
                ],
            ),
        )
    )  # fmt: skip


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "export.json").read_text())))
