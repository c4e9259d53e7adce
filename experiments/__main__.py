"""The runner: `python -m experiments` lists the experiments, `python -m experiments NAME` runs one.

`all` runs every one and makes a page of what they wrote, `page` makes it of the committed results, and `check` compares
what runs have written with those.
"""

import argparse
import ast
import importlib
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

# Has to be there before JAX starts, and for the processes that experiments start.
os.environ["JAX_ENABLE_X64"] = "1"

EXPERIMENTS = {
    "silverbox": "identification.silverbox",
    "silverbox_terms": "identification.silverbox_terms",
    "silverbox_comparison": "identification.comparison",
    "double_pendulum_measured": "identification.double_pendulum_measured",
    "bouc_wen": "identification.bouc_wen",
    "emps": "identification.emps",
    "tanks": "identification.tanks",
    "friction": "friction.friction",
    "events": "events.events",
    "contact": "contact.contact",
    "stiff_joint": "identification.stiff_joint",
    "vehicle": "identification.vehicle",
    "robots": "robots.robots",
    "squeezer": "identification.squeezer",
    "kim2019": "kim2019.kim2019",
    "cardona_geradin1989": "cardona_geradin1989.cardona_geradin1989",
    "reported": "reported.reported",
    "scenes": "scenes.scenes",
    "linearization": "linearization.linearization",
    "stability": "stability.stability",
    "flexible": "flexible.flexible",
    "sweeps": "sweeps.sweeps",
    "export": "export.export",
    "gradient_cost": "benchmarks.gradient_cost",
    "benchmarks": "benchmarks.benchmarks",
    "work_precision": "work_precision.work_precision",
}
SYNCHRONOUS = ("work_precision",)  # which waits for each call: JAX's asynchronous dispatch takes 10 us of it
IN_PART = ("silverbox",)  # without --full these show a part; their run takes a third argument
MORE = " (A first look; all of it with --full.)"
COMMANDS = {
    "all": "Every one of them, in full, and a page of what they wrote, experiments.html.",
    "page": "That page from the committed results instead, without running anything.",
    "check": "Compares what runs have written with the committed numbers; fails where one got worse.",
}
HERE = Path(__file__).parent


def summary(module: str) -> str:
    """First line of an experiment's docstring, without importing it."""
    source = (HERE / f"{module.replace('.', '/')}.py").read_text()
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]


def listing() -> str:
    """The experiments, a line each."""
    lines = [(name, summary(module) + MORE * (name in IN_PART)) for name, module in EXPERIMENTS.items()]
    lines = [f"  {name:<26}{text}" for name, text in [*lines, *COMMANDS.items()]]
    return "\n".join(["Experiments:", *lines, "", USAGE])


def run_alone(arguments: list[str]) -> int:
    """The exit code of the runner in a process of its own."""
    command = [sys.executable, "-m", "experiments", *arguments]
    result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    print(result.stdout, end="", flush=True)
    return result.returncode


def run_every_one(options) -> int:
    """All experiments, each in a process of its own: none changes the times of another, or ends the others if it fails.

    One after the other; smoke runs, whose times are void, share as many processes as there are cores.
    """
    size = {name: ["--fast"] if options.fast else ["--full"] if name in IN_PART else [] for name in EXPERIMENTS}
    every = [[name, *size[name], "--out", str(options.out), "--formats", options.formats] for name in EXPERIMENTS]
    if options.fast:
        from experiments.smoke import run_beside

        with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
            codes = list(pool.map(run_beside, every))
    else:
        codes = map(run_alone, every)
    failed = [name for name, code in zip(EXPERIMENTS, codes, strict=True) if code]
    if failed:
        print(f"Failed: {', '.join(failed)}.", file=sys.stderr)
    return int(bool(failed))


USAGE = "python -m experiments NAME [--fast | --full | --parts A,B] [--gpu] [--out DIR] [--formats png,pdf,svg]"


def parse(arguments: list[str]):
    """Name and options."""
    parser = argparse.ArgumentParser(prog="python -m experiments", usage=USAGE)
    parser.add_argument("name", nargs="?", help="experiment to run; without it, they are listed")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--fast", action="store_true", help="a smoke run: less data, fewer settings")
    size.add_argument("--full", action="store_true", help=f"everything, where less is shown by default: {IN_PART[0]}")
    size.add_argument("--parts", default="", help="of an experiment in parts, these; the numbers of the others stay")
    parser.add_argument("--gpu", action="store_true", help="benchmarks alone: on the accelerator that JAX finds")
    parser.add_argument("--out", type=Path, default=HERE / "output", help="folder for figures, JSON and page")
    parser.add_argument("--formats", default="png", help="of figures: png, pdf, svg, or several with commas")
    options = parser.parse_args(arguments)
    if options.full and options.name not in (*IN_PART, "all"):
        parser.error(f"--full is for {', '.join(IN_PART)}; the others show everything they have anyway")
    if options.parts and options.name in COMMANDS:
        parser.error("--parts is for one experiment")
    if options.gpu and (options.name != "benchmarks" or options.parts):
        parser.error("--gpu is for benchmarks, and a part of its own")
    return options


def run(name: str, options) -> None:
    """One experiment, in this process."""
    if name in SYNCHRONOUS:
        import jax

        jax.config.update("jax_cpu_enable_async_dispatch", False)  # before it starts
    from experiments.report import Report

    part = name in IN_PART and not options.full and not options.fast
    parts = ("accelerator",) if options.gpu else tuple(filter(None, options.parts.split(",")))
    flag = " --fast" if options.fast else " --full" if options.full else ""
    flag += " --gpu" if options.gpu else f" --parts {options.parts}" if parts else ""
    mode = "fast" if options.fast else "part" if part else "full"
    report = Report(name, options.out, mode, f"python -m experiments {name}{flag}", options.formats.split(","), parts)
    module = importlib.import_module(f"experiments.{EXPERIMENTS[name]}")
    known = [part.__name__.rpartition(".")[2] for part in getattr(module, "PARTS", [])]
    if not options.gpu and (unknown := [part for part in parts if part not in known]):
        sys.exit(f"{name} has {'the parts ' + ', '.join(known) if known else 'no parts'}; received {unknown[0]!r}.")
    module.run(report, options.fast, *([options.full] if name in IN_PART else []))
    report.close()


def write_page(out: Path, committed: bool) -> None:
    """The page of results."""
    from experiments.html_report import page
    from experiments.results import of_experiments

    path = out / "experiments.html"
    out.mkdir(parents=True, exist_ok=True)
    path.write_text(page(of_experiments(EXPERIMENTS, None if committed else out)), encoding="utf-8")
    print(f"Page: {path}", flush=True)


def main(arguments: list[str]) -> int:
    """Runs the experiment or command named, or lists them all."""
    options = parse(arguments)
    if options.name is None:
        print(listing())
        return 0
    if options.name not in EXPERIMENTS and options.name not in COMMANDS:
        print(f"Unknown experiment {options.name!r}.\n{listing()}", file=sys.stderr)
        return 2
    if options.name == "check":
        from experiments.check import check

        return check(EXPERIMENTS, options.out)
    failed = 0
    if options.name == "all":
        failed = run_every_one(options)
    elif options.name != "page":
        run(options.name, options)
    if options.name in ("all", "page"):
        write_page(options.out, committed=options.name == "page")
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
