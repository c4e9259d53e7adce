"""Numbers as HTML: a dict or a list of any shape becomes tables that can be sorted, nested where they are nested."""

import json
from html import escape
from typing import Any

SHORT = 6  # numbers of a list that fit into a cell
WORDS = 24  # letters up to which a cell is one line
OPEN = 60  # numbers up to which a part is shown unfolded
COLUMNS = 12  # beyond these, a table of few rows is turned on its side


class Markup(str):
    """HTML for a cell, which is not escaped again."""


def is_leaf(value) -> bool:
    """Whether it fits into a cell: a number, a word, or a list of them."""
    if isinstance(value, list):
        return not any(isinstance(x, (list, dict)) for x in value)
    return not isinstance(value, dict)


def count(value) -> int:
    """How many numbers there are in it."""
    if isinstance(value, (dict, list)):
        return sum(map(count, value.values() if isinstance(value, dict) else value))
    return isinstance(value, (int, float))


def text(value) -> str:
    """A scalar in a few characters."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def breakable(key: str) -> str:
    """Escaped, and free to break after an underscore."""
    return escape(key).replace("_", "_<wbr>")


def folded(title: str, body: str, unfold: bool = False) -> str:
    """A part that opens on a click."""
    return f"<details{' open' if unfold else ''}><summary>{title}</summary>{body}</details>"


def cell(value) -> str:
    """A td; numbers carry all their digits, to sort by and to hover over."""
    if isinstance(value, Markup):
        return f"<td>{value}</td>"
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return f'<td data-v="{value!r}" title="{value!r}">{text(value)}</td>'
    if isinstance(value, (list, dict)) and (not is_leaf(value) or len(value) > SHORT):
        whole = escape(json.dumps(value))
        return f'<td class="w">{folded(f"{count(value)} numbers", f"<code>{whole}</code>")}</td>'
    if isinstance(value, list):
        return f"<td>{escape(', '.join(map(text, value)))}</td>"
    if isinstance(value, str):
        return f"<td{' class=w' if len(value) > WORDS else ''}>{escape(value)}</td>"
    return f'<td class="n">{text(value)}</td>'


def table(header: list[str], rows: list[list], sortable: bool = True) -> str:
    """A table; click a heading to sort by its column."""
    head = "".join(heading(h, [row[i] for row in rows], sortable) for i, h in enumerate(header))
    body = "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows)
    return f'<div class="t" tabindex="0"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def heading(title: str, column: list, sortable: bool) -> str:
    """A th, to the right above numbers."""
    numbers = all(x is None or (isinstance(x, (int, float)) and not isinstance(x, bool)) for x in column)
    inner = f"<button>{breakable(title)}</button>" if sortable else breakable(title)
    return f'<th scope="col"{" class=n" if numbers else ""}>{inner}</th>'


def flat(values: dict, before: str = "") -> dict[str, Any]:
    """Nested dicts as one, keys joined by a slash."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{before}{key} / ") if isinstance(value, dict) else {f"{before}{key}": value}
    return found


def table_of(rows: list[dict]) -> str:
    """Rows with the union of their keys as columns; few rows with many columns are turned on their side."""
    rows = [flat(row) for row in rows]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    if len(columns) > COLUMNS and len(rows) < len(columns) / 3:
        first, *others = columns
        heads = [str(row.get(first, "")) for row in rows]
        return table([first or "number", *heads], [[c, *(row.get(c) for row in rows)] for c in others])
    return table(columns, [[row.get(c) for c in columns] for row in rows])


def alike(dicts: list) -> bool:
    """Whether they have mostly the same keys, and fit into the rows of one table."""
    if len(dicts) < 2 or not all(isinstance(d, dict) for d in dicts):
        return False
    keys = [flat(d) for d in dicts]
    union = len({key for k in keys for key in k})
    return union <= 80 and all(2 * len(k) >= union for k in keys) and all(is_leaf(x) for k in keys for x in k.values())


def matrix(rows: list[list]) -> str:
    """Rows by number; wide ones are turned on their side."""
    longest = max(map(len, rows))
    rows = [[*row, *[None] * (longest - len(row))] for row in rows]
    if longest > COLUMNS and len(rows) < longest / 3:
        rows = [list(column) for column in zip(*rows, strict=True)]
    return table(["", *map(str, range(len(rows[0])))], [[i, *row] for i, row in enumerate(rows)])


def render(value) -> str:
    """Tables of whatever an experiment wrote."""
    if isinstance(value, list):
        if value and all(isinstance(x, dict) for x in value):
            return table_of(value)
        if value and all(isinstance(x, list) for x in value):
            return matrix(value)
    if not isinstance(value, dict):
        return table(["value"], [[value]], sortable=False)
    leaves = {key: x for key, x in value.items() if is_leaf(x)}
    branches = {key: x for key, x in value.items() if key not in leaves}
    parts = [table(["number", "value"], [[k, x] for k, x in leaves.items()])] if leaves else []
    if alike(list(branches.values())):
        return "".join([*parts, table_of([{"": key, **x} for key, x in branches.items()])])
    for key, x in branches.items():
        numbers = count(x)
        title = f"{breakable(key)} <small>{numbers} numbers</small>"
        parts.append(folded(title, render(x), unfold=numbers <= OPEN))
    return "".join(parts)
