"""The runner: `python -m experiments` lists the experiments, `python -m experiments NAME` runs one."""

import argparse
import ast
import importlib
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

# Has to be there before JAX starts, and for the processes that experiments start.
os.environ["JAX_ENABLE_X64"] = "1"

EXPERIMENTS = {
    "silverbox": "identification.silverbox",
    "silverbox_comparison": "identification.comparison",
    "double_pendulum_measured": "identification.double_pendulum_measured",
    "bouc_wen": "identification.bouc_wen",
    "stiff_joint": "identification.stiff_joint",
    "vehicle": "identification.vehicle",
    "squeezer": "identification.squeezer",
    "kim2019": "kim2019.kim2019",
    "cardona_geradin1989": "cardona_geradin1989.cardona_geradin1989",
    "linearization": "linearization.linearization",
    "stability": "stability.stability",
    "sweeps": "sweeps.sweeps",
    "gradient_cost": "benchmarks.gradient_cost",
    "benchmarks": "benchmarks.benchmarks",
    "work_precision": "work_precision.work_precision",
}
HERE = Path(__file__).parent


def summary(module: str) -> str:
    """First line of an experiment's docstring, without importing it."""
    source = (HERE / f"{module.replace('.', '/')}.py").read_text()
    return (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]


def listing() -> str:
    """The experiments, a line each."""
    lines = [f"  {name:<26}{summary(module)}" for name, module in EXPERIMENTS.items()]
    return "\n".join(["Experiments:", *lines, f"  {'all':<26}Every one of them.", "", USAGE])


def run_side_by_side(options: list[str]) -> int:
    """Every experiment in a process of its own, as many at a time as cores; for smoke runs, whose times are void."""

    def run(name: str) -> int:
        command = [sys.executable, "-m", "experiments", name, *options]
        result = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        print(result.stdout, end="", flush=True)
        return result.returncode

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return max(pool.map(run, EXPERIMENTS))


USAGE = "python -m experiments NAME [--fast] [--out DIR]"


def main(arguments: list[str]) -> int:
    """Runs the experiment named, or lists them all."""
    parser = argparse.ArgumentParser(prog="python -m experiments", usage=USAGE)
    parser.add_argument("name", nargs="?", help="experiment to run; without it, they are listed")
    parser.add_argument("--fast", action="store_true", help="a smoke run: less data, fewer settings")
    parser.add_argument("--out", type=Path, default=HERE / "output", help="folder for figures and JSON")
    options = parser.parse_args(arguments)
    if options.name is None:
        print(listing())
        return 0
    if options.name != "all" and options.name not in EXPERIMENTS:
        print(f"Unknown experiment {options.name!r}.\n{listing()}", file=sys.stderr)
        return 2

    if options.name == "all" and options.fast:
        return run_side_by_side(["--fast", "--out", str(options.out)])

    from experiments.report import Report

    for name in EXPERIMENTS if options.name == "all" else [options.name]:
        module = importlib.import_module(f"experiments.{EXPERIMENTS[name]}")
        report = Report(name, options.out)
        module.run(report, options.fast)
        report.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
