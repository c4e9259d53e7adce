"""Where in a user's files an operation comes from."""

from contextvars import ContextVar
from pathlib import Path

import jax

OURS = str(Path(__file__).parents[1])
THEIRS = str(Path(str(jax.__file__)).parent)
# {loop: what has become of it}, while `explain` asks
asked: ContextVar = ContextVar("hhtjax_paths", default=None)


def line_of(eqn):
    """ "file.py, line 12, in force" of the innermost function that is neither JAX's nor ours; None where none is."""
    traceback = getattr(eqn.source_info, "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        if not frame.file_name.startswith((OURS, THEIRS, "<")):
            return f"{Path(frame.file_name).name}, line {frame.line_num}, in {frame.function_name}"
    return None
