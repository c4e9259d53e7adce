"""Makes README.md from the committed benchmarks.json, so that no number is copied by hand.

python -m experiments.benchmarks.page
"""

import json
from pathlib import Path

from experiments.page import busy, find, table

HERE = Path(__file__).parent
PREDICTOR, AUTO, CONVERGED = "non-iterative, predictor", "non-iterative, auto", "converged"


def number(x, unit=""):
    """Three digits, or a dash."""
    return "-" if x is None else f"{x:.3g}{unit}"


def rows_table(rows, columns):
    """columns: {heading: key}; numbers to three digits."""
    cells = [[x if isinstance(x := row.get(key), str) else number(x) for key in columns.values()] for row in rows]
    return table(list(columns), cells)


def bars(numbers):
    """What was aimed at and what was found: (quantity, target, measured, met)."""
    c, stiff = numbers["against_c"], numbers["against_c"]["stiff_ns_per_step"]
    single = {(r["trigonometry"], r["saved"]): r for r in c["single"] if r["method"] == PREDICTOR}
    gradient = find(numbers["gradients"]["long"], steps=100_000, saved="path")
    found = []
    if c["c_ns_per_step"]:
        found += [
            ("time over C: one trajectory, predictor, end saved", 1.1, single["jnp", "end"]["over_c"]),
            ("time over C: one trajectory, auto", 1.5, find(c["single"], method=AUTO, trigonometry="jnp")["over_c"]),
        ]
        found += [
            (
                f"time over C: batch of 256, {method.split()[-1]}, {where}",
                limit,
                find(c["batch"], method=method, trigonometry="jnp", vectors_bits=bits)["over_c"],
            )
            for method, limit in ((PREDICTOR, 1.1), (AUTO, 1.5))
            for bits, where in ((512, "wide vectors"), (256, "a user's jit"))
        ]
    for name in ("polynomial", "jnp"):
        ratio = single[name, "path"]["ns_per_step"] / single[name, "end"]["ns_per_step"]
        found.append((f"time, all steps saved over only the end, {name} sines", 1.3, ratio))
    found += [
        ("time, value and gradient over value (4 parameters, 1e5 steps, path)", 4.0, gradient["gradient_over_forward"]),
        ("temporary memory of that gradient, MB", 5.0, gradient["gradient_temporary_bytes"] / 1e6),
    ]
    for r in numbers["compile_time"]["rows"]:
        if r["method"] == "hht, auto" and r["over_kvaerno3"] is not None:
            limit = 0.5 if r["compiled"] == "run" else 1.0
            found.append(
                (f"compile time of a {r['compiled']} over that of diffrax Kvaerno3", limit, r["over_kvaerno3"])
            )
    at_least = [
        ("time, converged over predictor (stiff joints, jnp sines)", 2.0, stiff[CONVERGED] / stiff[PREDICTOR]),
        ("time, converged over auto (stiff joints, jnp sines)", 2.0, stiff[CONVERGED] / stiff[AUTO]),
    ]
    fast = {
        r["method"]: r["ns_per_step"] for r in c["single"] if (r["trigonometry"], r["saved"]) == ("polynomial", "end")
    }
    ratio = fast[CONVERGED] / fast[PREDICTOR]
    at_least.append(("time, converged over predictor (free joints, polynomial sines)", 2.0, ratio))
    for N, limit in ((8, 8.0), (16, 9.0), (64, 30.0)):
        mine = [r["faster_than_obvious_N2"] for r in numbers["chains"]["rows"] if r["N"] == N and r["step"] == "ours"]
        at_least.append((f"time, plain JAX over ours, chain of {N}", limit, max(mine)))
    lines = [[what, f"<= {limit:g}", f"{x:.2f}", "yes" if x <= limit else "no"] for what, limit, x in found]
    lines += [[what, f">= {limit:g}", f"{x:.2f}", "yes" if x >= limit else "no"] for what, limit, x in at_least]
    return table(["quantity", "target", "measured", "met"], lines)


def first_call_rows(numbers, before):
    """A row for each scene and call, beside what it took at an earlier commit, and what plain JAX takes."""
    then = {(r["scene"], r["call"]): r["cpu_time_s"]["total"] for r in before["rows"]}
    rows = []
    for r in numbers["rows"]:
        total, earlier = r["cpu_time_s"]["total"], then[r["scene"], r["call"].split(",")[0]]
        row = {**r, **r["cpu_time_s"], "before": earlier, "over before": total / earlier}
        row |= {"with a cache": r["with_cache_cpu_time_s"], "share": r["with_cache_cpu_time_s"] / total}
        if (plain := r.get("obvious_cpu_time_s")) is not None:
            share = r["obvious_with_cache_cpu_time_s"] / plain
            row |= {"plain JAX": plain, "plain over before": plain / earlier, "plain's share": share}
        rows.append(row)
    return rows


def halves(rows):
    """How many first calls take half of before at most, and which do not though plain JAX does."""
    rows = [r for r in rows if r["call"] != "gradient, QUICK"]
    more = [r for r in rows if r["over before"] > 0.5]
    bounded = [r for r in more if r.get("plain over before", 0) > 0.5]
    left = ", ".join(f"{r['scene']} ({r['call']})" for r in more if r not in bounded) or "none"
    return (
        f"{len(rows) - len(more)} of {len(rows)} first calls take at most half of the total before. In {len(bounded)} "
        f"of the others plain JAX also takes more than half. The rest: {left}."
    )


def first_call(rows):
    """The table of these."""
    columns = "scene", "call", "before", "total", "over before", "plain JAX", "plain over before", "tracing"
    columns = *columns, "lowering", "compiling", "with a cache", "share", "plain's share"
    return rows_table(rows, {"cached" if name == "with a cache" else name: name for name in columns})


def calls(numbers):
    """What a call costs beside its steps, if that was ever measured: `--parts calls`."""
    if numbers is None:
        return "Not measured in this run. To measure: `python -m experiments benchmarks --parts calls`."
    rows = [{**r["us"], **r} for r in numbers["rows"]]
    ratios = [key for key in rows[0] if key.endswith("ratio")]
    times = {f"{way} (us)": way for way in numbers["rows"][0]["us"]}
    return rows_table(rows, {"system": "system", "steps": "steps", **{key: key for key in ratios}, **times})


def dense(rows):
    """Ours beside the loop by hand."""
    columns = {"ours (us)": "ours_us_per_step", "by hand (us)": "hand_us_per_step", "ratio": "over_hand"}
    rows = [{**r, "n": f"{r['n']}", "busy": f"{r['busy_processes']}"} for r in rows]
    return rows_table(rows, {"n": "n", "busy": "busy", **columns, "ratio of medians": "median_over_hand"})


def sparse(rows):
    """ms per step in every way."""
    names = list(dict.fromkeys(name for r in rows for name in r["ms_per_step"]))
    rows = [{**r["ms_per_step"], **r, "n": f"{r['n']}"} for r in rows]
    columns = {f"{name} (ms)": name for name in names}
    return rows_table(rows, {"mesh": "mesh", "n": "n", **columns, "sparse over SuperLU": "over_superlu"})


def accelerator(numbers):
    """What `--gpu` measured, if it was ever run."""
    if numbers is None:
        return (
            "Not measured: this machine has no accelerator. On a machine with one, `python -m experiments benchmarks "
            "--gpu` measures `vmap` of a run of the double pendulum with up to a million members, diffrax's beside it, "
            "and 8.4 million Lorenz systems in single precision. Nothing in the library is made for accelerators; it "
            "runs there as plain JAX."
        )
    rows = [{"members": f"{r['members']}", **r["ns_per_step_and_member"]} for r in numbers["pendulums"]]
    lorenz = numbers["lorenz"]
    published = ", ".join(f"{name}: {x} ms" for name, x in lorenz["published_ms"].items())
    return (
        f"{numbers['device']}, jax {numbers['jax']}; double pendulums in float64, warm, ns per step and member:\n\n"
        f"{rows_table(rows, {key: key for row in rows for key in row})}\n\n"
        f"{lorenz['members']} Lorenz systems, {lorenz['num_steps']} steps of `rk4` in float32: "
        f"{lorenz['time_ms']:.3g} ms (published: {published})."
    )


def page(numbers):
    """The text of README.md."""
    c, batches, gradients = (numbers[part] for part in ("against_c", "batches", "gradients"))
    machine, before = numbers["machine"], json.loads((HERE / "first_call_before.json").read_text())
    firsts = first_call_rows(numbers["first_call"], before)
    differences = [
        r["q_minus_c_rad"] for r in c["single"] if r["method"] == PREDICTOR and r["q_minus_c_rad"] is not None
    ]
    columns = list(dict.fromkeys(key for row in batches["rows"] for key in row if key != "num_steps"))
    missing = numbers["compile_time"]["not_installed"]
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=(
                f"{machine['processor']}, {machine['cores']} cores; jax {machine['jax']}, Python {machine['python']}; "
                f"{machine['compiler'] or 'no C compiler'}; load at the start "
                f"{machine['load_at_start']:.1f}{busy(machine)}; "
                f"`XLA_FLAGS={machine['XLA_FLAGS']}`."
            ),
            bars=bars(numbers),
            single_over_c=find(c["single"], method=PREDICTOR, trigonometry="jnp", saved="end")["over_c"],
            batch_over_c=find(c["batch"], method=PREDICTOR, trigonometry="jnp", vectors_bits=512)["over_c"],
            gradient_over=find(gradients["long"], steps=100_000, saved="path")["gradient_over_forward"],
            first_least=min(r["total"] for r in firsts if r["call"] == "simulate"),
            first_most=max(r["total"] for r in firsts if r["call"] == "simulate"),
            difference=number(max(differences, default=None)),
            steps=c["num_steps"],
            single=rows_table(
                c["single"],
                {
                    "method": "method",
                    "sines": "trigonometry",
                    "saved": "saved",
                    "ns per step": "ns_per_step",
                    "over the best C": "over_c",
                    "compile (s)": "compile_s",
                },
            ),
            c=table(["C", "ns per step"], [[name, number(x)] for name, x in c["c_ns_per_step"].items()]),
            members=c["members"],
            batch=rows_table(
                [{**r, "bits": f"{r['vectors_bits']}"} for r in c["batch"]]
                + [{"method": name, "bits": "", "ns_per_step_and_member": x} for name, x in c["c_batch_ns"].items()],
                {
                    "method": "method",
                    "sines": "trigonometry",
                    "vectors (bits)": "bits",
                    "ns per step and member": "ns_per_step_and_member",
                    "over the best C": "over_c",
                },
            ),
            stiff=", ".join(f"{name} {x:.0f}" for name, x in c["stiff_ns_per_step"].items()),
            structure=rows_table(
                numbers["structure"]["rows"],
                {
                    "structure": "structure",
                    "N": "N",
                    "us per step": "us_per_step",
                    "without (us)": "without_us_per_step",
                    "ratio": "time_over_without",
                },
            ),
            block=batches["block"],
            batches=table(
                columns, [[f"{x:.4g}" if (x := r.get(k)) else "-" for k in columns] for r in batches["rows"]]
            ),
            over=", ".join(f"{name} {x:.0f}" for name, x in batches["over"].items()),
            long=rows_table(
                [{**r, "MB": r["gradient_temporary_bytes"] / 1e6, "steps": f"{r['steps']}"} for r in gradients["long"]],
                {"steps": "steps", "saved": "saved", "ratio": "gradient_over_forward", "MB": "MB"},
            ),
            num_steps=gradients["num_steps"],
            gradients=rows_table(
                [{**r, "MB": r["temporary_bytes"] / 1e6} for r in gradients["rows"]],
                {
                    "derivative": "derivative",
                    "us per step": "us_per_step",
                    "over the primal": "over_primal",
                    "MB": "MB",
                    "compile (s)": "compile_s",
                },
            ),
            chains=rows_table(
                [{**r, "step": r["step"].replace("obvious", "plain JAX")} for r in numbers["chains"]["rows"]],
                {
                    "N": "N",
                    "step": "step",
                    "formulation": "formulation",
                    "us per step": "us_per_step",
                    "plain, same sines / this": "faster_than_obvious_same_functions",
                    "plain, N^2 sines / this": "faster_than_obvious_N2",
                },
            ),
            compile_steps=numbers["compile_time"]["num_steps"],
            not_installed=f"Not installed on this machine: {', '.join(missing)}." if missing else "",
            compile=rows_table(
                numbers["compile_time"]["rows"],
                {"method": "method", "program": "compiled", "s": "compile_s", "over Kvaerno3": "over_kvaerno3"},
            ),
            first_steps=numbers["first_call"]["num_steps"],
            first_call=first_call(firsts),
            halves=halves(firsts),
            calls=calls(numbers.get("calls")),
            before=before,
            cores=machine["cores"],
            busy=max(r["busy_processes"] for r in numbers["many_unknowns"]["dense"]),
            dense_steps=numbers["many_unknowns"]["num_steps"],
            dense=dense(numbers["many_unknowns"]["dense"]),
            sparse=sparse(numbers["many_unknowns"]["sparse"]),
            accelerator=accelerator(numbers.get("accelerator")),
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "benchmarks.json").read_text())))
