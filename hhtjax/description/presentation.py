"""How results print in a notebook, a terminal or a log: shapes, dtypes and verdicts, never arrays.

Nothing here computes with JAX, because a result may hold tracers, or be printed while something else is being traced.
"""

from __future__ import annotations

import html
import shutil
import sys
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from hhtjax.description import PyTree, is_array, is_concrete, is_real

Kind = TypeVar("Kind", bound=type)
MOST = 16  # rows of a table, or entries of a container
LINE = "text-align: left; border-bottom: 1px solid rgba(128, 128, 128, 0.35)"  # seen on light and on dark
CHARTS = {}  # how results draw themselves, by class: entered by `hhtjax`, as charts lie above what they show


class Table(NamedTuple):
    """The printed form of a result: a title with the verdict, and rows, of which the first is the header."""

    title: str
    rows: list[list[str]]


def shown(cls: Kind) -> Kind:
    """Makes a named tuple print in one line, or by its method `_table`, and complete to its own names only.

    A method `_verdict` adds words to the line. It remains a tuple for `isinstance`, comparison and `jax.tree`.

    >>> @shown
    ... class Point(NamedTuple):
    ...     x: Any
    ...     name: Any = None
    >>> Point(np.zeros((3, 2)), "start"), "count" in dir(Point(1.0))
    (Point(x=float64[3,2], name='start'), False)
    """
    named: Any = cls
    named.__repr__ = line
    named.__dir__ = lambda self: [name for name in object.__dir__(self) if name not in ("count", "index")]
    if hasattr(cls, "_table"):
        named.__repr__ = lambda self: as_text(self._table())
        named._repr_html_ = lambda self: as_html(self._table())
    return cls


def line(x) -> str:
    """A named tuple in one line."""
    told = [x._verdict()] if hasattr(x, "_verdict") else []
    told += [f"{name}={brief(y)}" for name, y in zip(x._fields, x, strict=True) if y is not None]
    return f"{type(x).__name__}({_some(filter(None, told))})"


def brief(x: PyTree) -> str:
    """A few characters: a number as it is, an array as float64[3,2], a container by its contents."""
    value = known(x)
    if value is not None and not value.ndim:
        return f"{value:.6g}" if value.dtype.kind == "f" else str(value)
    if hasattr(x, "shape") and hasattr(x, "dtype"):
        return f"{x.dtype}{str(list(x.shape)).replace(' ', '')}"
    if hasattr(x, "_table"):
        return f"<{x._table().title}>"
    if hasattr(x, "_fields"):
        return line(x)
    if isinstance(x, dict):
        return f"{{{_some(f'{name}: {brief(y)}' for name, y in x.items())}}}"
    if isinstance(x, list | tuple):
        first, last = "[]" if isinstance(x, list) else "()"
        return f"{first}{_some(map(brief, x))}{last}"
    return repr(x) if x is None or isinstance(x, str | bool) else f"<{getattr(x, '__name__', type(x).__name__)}>"


def _some(entries) -> str:
    entries = list(entries)
    return ", ".join([*entries[:MOST], *([f"and {len(entries) - MOST} more"] if len(entries) > MOST else [])])


def known(x: PyTree) -> Any:
    """The values of an array, or a number, as a NumPy array; None if they are not available: for a tracer, or on other
    processes."""
    if isinstance(x, bool):
        return np.asarray(x)
    if (not (is_array(x) and x.dtype == bool) and not is_real(x)) or not is_concrete(x):
        return None
    if isinstance(x, jax.Array) and (x.is_deleted() or not x.is_fully_addressable):
        return None
    return np.asarray(x)


def all_known(tree: PyTree) -> list:
    """`known` of each leaf; an empty list if one is not available."""
    numbers = [known(x) for x in jax.tree.leaves(tree)]
    return [] if any(x is None for x in numbers) else numbers


def leaf_rows(**trees: PyTree):
    """Name, shape and dtype of each array in pytrees, as rows of a table; trees that are None are omitted."""
    rows = []
    for name, tree in trees.items():
        for path, x in jax.tree_util.tree_leaves_with_path(tree):
            where = jax.tree_util.keystr(path, simple=True, separator=".")
            size = [str(tuple(x.shape)), str(x.dtype)] if hasattr(x, "shape") else [brief(x), ""]
            rows.append([f"{name}.{where}" if where else name, *size])
    return rows


def between(x: np.ndarray, unit: str = "", digits: int = 6) -> str:
    """The range of known numbers, in words."""
    least, most = (f"{end:.{digits}g}" for end in (np.min(x), np.max(x)))
    return (least if least == most else f"{least} ... {most}") + (f" {unit}" if unit else "")


def frequency_cells(w: float) -> list[str]:
    """A frequency in rad/s, the same in Hz, and its period, as cells of a table.

    >>> frequency_cells(100.0), frequency_cells(0.0)
    (['100', '15.9', '0.0628 s'], ['0', '0', '-'])
    """
    hertz = w / (2 * np.pi)
    return [f"{w:.4g}", f"{hertz:.3g}", f"{1 / hertz:.3g} s" if hertz else "-"]


def _shortened(table: Table):
    """At most `MOST` rows, and the number of omitted ones."""
    left = len(table.rows) - 1 - MOST
    return table.rows[: MOST + 1], f"and {left} more" if left > 0 else ""


def as_text(table: Table) -> str:
    """Title and columns."""
    rows, more = _shortened(table)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["    " + "  ".join(x.ljust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([table.title, *lines, *(["    " + more] if more else [])])


def as_html(table: Table) -> str:
    """The table as HTML, in the colours of the page."""
    rows, more = _shortened(table)

    def line(kind: str, cells: list) -> str:
        return "<tr>" + "".join(f'<{kind} style="{LINE}">{html.escape(x)}</{kind}>' for x in cells) + "</tr>"

    body = "".join([line("th", rows[0]), *(line("td", row) for row in rows[1:])])
    return f"<div>{html.escape(table.title)}</div><table>{body}</table><div>{more}</div>"


def overwrite(line: str, last: bool):
    """Writes a line to stderr that replaces the previous one, in a terminal and in a notebook; the last one stays.

    An empty line erases it.
    """
    if sys.stderr is None:  # of a program without a console
        return
    width = shutil.get_terminal_size().columns - 1 if is_terminal() else 79
    line = line if last else line[:width]  # one that is longer cannot be rewritten
    end = "\n" if last else "" if line else "\r"
    sys.stderr.write(f"\r{line:<{width}}{end}")
    sys.stderr.flush()


def is_terminal() -> bool:
    """Whether stderr is a terminal, and not a file, a pipe or a notebook."""
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):  # there is none, or it is closed
        return False
