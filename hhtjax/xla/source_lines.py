"""Where in a user's files an operation comes from."""

import re
from contextvars import ContextVar
from pathlib import Path

import jax

OURS = str(Path(__file__).parents[1])
THEIRS = str(Path(str(jax.__file__)).parent)
# {name of a call: the line that keeps it from being a kernel}, while `explain` asks: not in the program, whose key in
# the cache on disk it would change
asked: ContextVar = ContextVar("hhtjax_lines", default=None)


def line_of(eqn):
    """ "file.py, line 12, in force" of the innermost function that is neither JAX's nor ours; None where none is."""
    traceback = getattr(eqn.source_info, "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        if not frame.file_name.startswith((OURS, THEIRS, "<")):
            return f"{Path(frame.file_name).name}, line {frame.line_num}, in {frame.function_name}"
    return None


def line_in(location):
    """The same of an operation in MLIR, whose location names functions, files and lines, the innermost first."""
    for function, file, line in re.findall(r'"([^"]*)"\("([^"]*)":(\d+)', str(location)):
        if not file.startswith((OURS, THEIRS, "<")):
            return f"{Path(file).name}, line {line}, in {function}"
    return None
