"""Makes README.md from the committed work_precision.json, so that no number is copied by hand.

python -m experiments.work_precision.page
"""

import json
from pathlib import Path

from experiments.page import busy, table
from experiments.work_precision.figures import PACKAGES, gradient_figures
from experiments.work_precision.gradients import SCENES
from experiments.work_precision.timing import FINEST
from experiments.work_precision.tree import draw_tree

HERE = Path(__file__).parent
STIFF = "stiff double pendulum"
BARS = {"0.001": 30, "0.0001": 18, "1e-06": 5}
SAMPLES = 50
KNOW_CONSTRAINTS = "hht", "extrapolated"
UNCOMPILED = PACKAGES[1:5]  # whose right-hand side crosses Python, or is in an engine of bodies: the bars are for these


def ms(t):
    """Milliseconds to three digits, or a dash."""
    return "-" if t is None else f"{1e3 * t:.3g}"


def best(entries, level, packages=PACKAGES):
    """(time, method) of the fastest, or (None, "-")."""
    found = [(e["time_s"][level], e["method"]) for e in entries if e["package"] in packages]
    return min(((t, m) for t, m in found if t is not None), default=(None, "-"))


def best_table(times):
    """Best times of each package: a row for each case and level."""
    present = [p for p in PACKAGES if any(e["package"] == p for entries in times.values() for e in entries)]
    rows = []
    for name, entries in times.items():
        for level in list(entries[0]["time_s"])[1:]:
            cells = []
            for package in present:
                t, method = best(entries, level, (package,))
                cells.append("-" if t is None else f"{ms(t)} ({method.removeprefix(package).strip()})")
            rows.append([name, level, *cells])
    return table(["scene", "error", *present], rows)


def bars(entries):
    """On the stiff double pendulum: peers over ours; the bars are for peers whose right-hand side crosses Python, and
    for engines."""
    rows = []
    for level, bar in BARS.items():
        (ours, method), (theirs, peer) = best(entries, level, PACKAGES[:1]), best(entries, level, UNCOMPILED)
        default = next(e["time_s"][level] for e in entries if e["method"] == "hht")
        ratios = ["-" if t is None or theirs is None else f"{theirs / t:.1f}" for t in (ours, default)]
        rows.append([level, f"{peer}: {ms(theirs)} ms", f"{method}: {ms(ours)} ms", *ratios, f">= {bar}"])
    return table(["error", "fastest of these", "our fastest", "ratio", "ratio to `hht()`", "target ratio"], rows)


def losses(times, default=None):
    """For each case the errors at which a peer is faster than all of ours, and those at which only `default` loses."""
    lines = []
    for name, entries in times.items():
        lost, default_lost = [], []
        for level in entries[0]["time_s"]:
            (ours, _), (theirs, peer) = best(entries, level, PACKAGES[:1]), best(entries, level, PACKAGES[1:])
            usual = next((e["time_s"][level] for e in entries if e["method"] == default), None)
            if theirs is None:
                continue
            if ours is None or theirs < ours:
                times_faster = "none of ours reaches it" if ours is None else f"{ours / theirs:.1f} times as fast"
                lost.append(f"{level} ({peer}: {times_faster})")
            elif default and (usual is None or theirs < usual):
                times_faster = (
                    f"{default} does not reach it" if usual is None else f"{usual / theirs:.1f} times as fast"
                )
                default_lost.append(f"{level} ({peer}: {times_faster})")
        if lost:
            lines.append(f"* {name}: all our methods lose at {', '.join(lost)}.")
        if default_lost:
            lines.append(f"* {name}: only the default `{default}()` loses, at {', '.join(default_lost)}.")
    return "\n".join(lines) or "Nowhere, in these runs."


def who_wins(times):
    """For each level: how often each package has the fastest method, over the scenes on which one gets there."""
    levels = list(dict.fromkeys(level for entries in times.values() for level in entries[0]["time_s"]))
    rows = []
    for level in levels:
        fastest = []
        for entries in times.values():
            t, method = best(entries, level) if level in entries[0]["time_s"] else (None, "-")
            fastest += [] if t is None else [next(e["package"] for e in entries if e["method"] == method)]
        counts = {package: fastest.count(package) for package in PACKAGES if package in fastest}
        told = ", ".join(f"{package} {n}" for package, n in sorted(counts.items(), key=lambda x: -x[1]))
        rows.append([level, told or "-"])
    return table(["error", "scenes on which each package is the fastest"], rows)


def answer(times):
    """On how many scenes ours is the fastest, at three errors, and who is where it is not."""
    counts = []
    for level in ("0.001", "1e-06", "1e-10"):
        found = [best(entries, level) for entries in times.values() if level in entries[0]["time_s"]]
        ours = [best(entries, level, PACKAGES[:1]) for entries in times.values() if level in entries[0]["time_s"]]
        counts.append(f"{sum(a[0] is not None and a == b for a, b in zip(found, ours, strict=True))} at {level}")
    return (
        f"Of {len(times)} scenes ours is the fastest package on {', '.join(counts)}. Elsewhere heyoka's Taylor series "
        f"or numbalsoda's compiled solvers are faster."
    )


def calls(numbers):
    """What a call costs."""
    found = numbers.get("calls_s")
    if found is None:
        return "A call: not measured in this run."
    told = ", ".join(f"`{kind}` {1e6 * t:.0f} us" for kind, t in found.items())
    return f"A warm call for one step of `hht()` on the stiff double pendulum takes: {told}."


def batches(numbers):
    """Of many members in one call."""
    found = numbers.get("batches")
    if found is None:
        return "Not measured in this run."
    text = (
        f"{found['members']} members, each with its own parameters (those of the gradients, times factors of "
        f"{1 - found['spread']:g} to {1 + found['spread']:g}), on {found['cores']} cores. Warm time in ms to reach an "
        f"error:"
    )
    tables = [times_table(entries, name) for name, entries in found["times"].items()]
    return "\n\n".join([text, *tables, losses(found["times"])])


def choices(numbers):
    """What is chosen for each scene, and what that costs beside the best of ours, by the times of this page."""
    found = numbers.get("choices")
    if found is None:
        return "Not measured in this run."
    rows = []
    for x in found:
        entries, level = numbers["times"][x["case"]], f"{x['level']:g}"
        mine = next((e["time_s"][level] for e in entries if e["method"] == x["method"]), None)
        as_it_is = x["form"] == "constraints, rotations"
        able = [e for e in entries if not as_it_is or e["method"].startswith(KNOW_CONSTRAINTS)]
        least, method = best(able, level, PACKAGES[:1])
        ratio = "-" if mine is None or least is None else f"{mine / least:.1f}"
        stiffness = "-" if x["stiffness"] is None else f"{x['stiffness']:.2g}"
        name = x["case"] if x["form"] == "as it is" else f"{x['case']}, {x['form']}"
        error = "-" if x["rms_error"] is None else f"{x['rms_error']:.0e}"
        rows.append(
            [
                name,
                level,
                stiffness,
                x["method"].removesuffix(", adaptive"),
                error,
                ms(mine),
                f"{ms(least)} ({method})",
                ratio,
            ]
        )
    return table(["scene", "error", "stiffness", "chosen", "its error", "ms", "our fastest (ms)", "ratio"], rows)


def parameters(names):
    """Of each scene those that its gradient is taken in."""
    note = " (the loss has the height of the rod alone: all entries of a rotation have a constant sum of squares)"
    return "; ".join(f"{x}: {', '.join(SCENES[x].keys)}{note if SCENES[x].seen else ''}" for x in names)


def times_table(entries, heading):
    """All methods, in ms."""
    levels = list(entries[0]["time_s"])
    return table([heading, *levels], [[e["method"], *(ms(e["time_s"][level]) for level in levels)] for e in entries])


def page(numbers):
    """The text of README.md."""
    machine, times, missing = numbers["machine"], numbers["times"], numbers["not_installed"]
    gradients = numbers["gradient_times"]
    versions = ", ".join(f"{name} {version}" for name, version in numbers["versions"].items())
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            machine=(
                f"{machine['processor']}, {machine['cores']} cores; jax {machine['jax']}, {versions}, Python "
                f"{machine['python']}; {machine['compiler'] or 'no C compiler'}; load at the start "
                f"{machine['load_at_start']:.1f}{busy(machine)}; `XLA_FLAGS={machine['XLA_FLAGS']}`."
            ),
            missing=f"Not installed on this machine, so left out: {', '.join(missing)}." if missing else "",
            samples=SAMPLES,
            longest=numbers["longest_s"],
            finest=FINEST,
            best=best_table(times),
            bars=bars(times[STIFF]),
            losses=losses(times, "hht"),
            wins=who_wins(times),
            answer=answer(times),
            packages=sum(any(e["package"] == p for x in times.values() for e in x) for p in PACKAGES),
            calls=calls(numbers),
            call_us=1e6 * numbers["calls_s"]["jit(simulate)"],
            empty_us=1e6 * numbers["calls_s"]["jit of nothing"],
            batches=batches(numbers),
            choices=choices(numbers),
            gradient_figures="\n\n".join(
                f"![Relative error of the gradient against time of value and gradient]({name}.png)"
                for name in gradient_figures(list(gradients))
            ),
            parameters=parameters(gradients),
            gradient_losses=losses(gradients),
            best_gradients=best_table(gradients),
            gradients="\n\n".join(times_table(entries, name) for name, entries in gradients.items()),
            tables="\n\n".join(times_table(entries, name) for name, entries in times.items()),
        )
    )


if __name__ == "__main__":
    found = json.loads((HERE / "work_precision.json").read_text())
    (HERE / "README.md").write_text(page(found))
    draw_tree(found["times"], HERE / "work_precision_tree.png")
