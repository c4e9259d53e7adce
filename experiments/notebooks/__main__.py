"""`python -m experiments.notebooks` renders every notebook from its script; `--check` runs them and compares sources.

NN_name.py is the source, in jupytext's percent format; NN_name.ipynb is made from it, with all outputs.
"""

import argparse
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LARGEST = 400_000  # bytes of a rendered notebook
LONGEST = 240  # s, of a cell: twice what the longest takes where two notebooks and the tests share two cores
WAITING = "hhtjax: tracing or compiling"  # a line for who waits, not for who reads
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}


def scripts(names):
    """The scripts whose names begin with one of `names`; all of them without names."""
    found = sorted(HERE.glob("[0-9][0-9]_*.py"))
    return [path for path in found if not names or path.stem.startswith(tuple(names))]


def source(path):
    """A script as a notebook without outputs; cells are numbered, so that rendering again changes outputs only."""
    notebook = jupytext.read(path, fmt="py:percent")
    notebook.metadata = nbformat.from_dict(METADATA)
    for number, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{number}", nbformat.from_dict({})
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    return notebook


def execute(notebook):
    """Runs all cells in a process of its own; what went wrong, or None."""
    client = NotebookClient(
        notebook,
        timeout=LONGEST,
        kernel_name="python3",
        record_timing=False,
        extra_arguments=["--IPKernelApp.log_level=40"],
        resources={"metadata": {"path": str(HERE)}},
    )
    try:
        client.execute()
    except CellExecutionError as error:
        return str(error)
    for cell in notebook.cells:
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if not output.get("text", "").startswith(WAITING)]
    return None


def is_current(path, notebook):
    """Whether the rendered notebook has the cells of the script."""
    rendered = path.with_suffix(".ipynb")
    if not rendered.exists():
        return False
    pairs = ([(cell.cell_type, cell.source) for cell in x.cells] for x in (notebook, nbformat.read(rendered, 4)))
    return next(pairs) == next(pairs)


def process(path, check):
    """Runs one notebook, and writes it unless checking; returns what is wrong with it."""
    begin, notebook = time.perf_counter(), source(path)
    troubles = []
    if check and not is_current(path, notebook):
        troubles.append(f"{path.stem}.ipynb differs from its script: run `python -m experiments.notebooks {path.stem}`")
    error = execute(notebook)
    if error:
        troubles.append(error)
    text = nbformat.writes(notebook) + "\n"
    if len(text) > LARGEST:
        troubles.append(f"{path.stem}.ipynb has {len(text)} bytes, more than {LARGEST}: make its figures smaller")
    if not check and not error:
        path.with_suffix(".ipynb").write_text(text)
    seconds = time.perf_counter() - begin
    print(f"{path.stem:<32}{seconds:6.1f} s  {len(text) / 1000:5.0f} kB  {'FAILED' if troubles else ''}", flush=True)
    return troubles


def environment():
    """What the kernels inherit: this checkout, and the measured data where `experiments` finds them."""
    from experiments.identification.data import data_folder

    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    os.environ.pop("MPLBACKEND", None)
    if data_folder().is_dir():
        os.environ["HHTJAX_DATA"] = str(data_folder())


def main(arguments):
    """Renders or checks, two at a time."""
    parser = argparse.ArgumentParser(prog="python -m experiments.notebooks")
    parser.add_argument("names", nargs="*", help="beginnings of names, such as 03; all without")
    parser.add_argument("--check", action="store_true", help="write nothing; fail where script and notebook differ")
    options = parser.parse_args(arguments)
    environment()
    with ThreadPoolExecutor(2) as pool:
        found = pool.map(lambda path: process(path, options.check), scripts(options.names))
        troubles = [trouble for troubles in found for trouble in troubles]
    for trouble in troubles:
        print(f"\n{trouble}", file=sys.stderr)
    return 1 if troubles else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
