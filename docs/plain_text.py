"""Docstrings as they are written here, for Sphinx: plain text, indented formulas, sections of Google's style.

indented block after an empty line    a formula (`formulas`); a table or code is shown as it stands
Args:, Returns:, Raises: ...          a list of what is named before the colon
`name`                                a link if it is a public name or a page, else code
Title over ----, table between ====   as in reStructuredText
"""

import importlib
import inspect
import pkgutil
import re
import textwrap
from pathlib import Path
from types import ModuleType

import formulas

import hhtjax

ROOT = Path(__file__).parents[1]
SECTIONS = ("Args", "Attributes", "Returns", "Raises", "Warns", "References")
TITLES = {"Args": "Arguments"}
HEADER = re.compile(rf"({'|'.join(SECTIONS)}):(?: (.+))?$")
ITEM = re.compile(r"(\*{0,2}[A-Za-z_][\w]*(?:, \*{0,2}[A-Za-z_]\w*)*|\"\w+\"): ?(.*)")

LIST = r"^(\* |)(?=\(?\w+[.)](\s|$))"  # "s." and initials, which begin no list
MARK = r"\\|\||(?<![\w])\*(?!\w+\*(?!\w))(?!(?<=^\*) )"  # not *emphasis*, and no bullet


def public_names():
    """The short name, and the one with its room, of all that is public -> where it is documented."""
    modules = {x.name: importlib.import_module(f"hhtjax.{x.name}") for x in pkgutil.iter_modules(hhtjax.__path__)}
    modules |= {name: x for name in hhtjax.__all__ if isinstance(x := getattr(hhtjax, name), ModuleType)}
    names = {f"hhtjax.{name}": x.__name__ for name, x in modules.items() if len(x.__doc__ or "") > 300}
    for short, room in modules.items():
        for name in getattr(room, "__all__", ()):
            is_at_top = getattr(hhtjax, name, None) is getattr(room, name)
            names[f"hhtjax.{short}.{name}"] = f"hhtjax.{name}" if is_at_top else f"hhtjax.{short}.{name}"
            names[f"{short}.{name}"] = names[f"hhtjax.{short}.{name}"]
            if short in ("analysis", "identification", "interop", "plot"):  # of two with one name the first
                names.setdefault(name, names[f"{short}.{name}"])
    top = [name for name in hhtjax.__all__ if name not in modules and name != "__version__"]
    return names | {f"hhtjax.{name}": f"hhtjax.{name}" for name in top} | {name: f"hhtjax.{name}" for name in top}


NAMES = public_names()


def inline(text):
    """Text with its marks escaped, and what stands between backticks as link or code."""
    parts = text.split("`")
    for i, part in enumerate(parts):
        if i % 2 == 0:
            part = re.sub(MARK, lambda mark: "\\" + mark[0], part, flags=re.MULTILINE)
            parts[i] = re.sub(r"_(?!\w)", r"\\_", part)
        elif part in NAMES:
            parts[i] = f":py:obj:`{part} <{NAMES[part]}>`"
        elif re.fullmatch(r"\S+\.(md|ipynb)", part) and (ROOT / part).exists():
            parts[i] = f":doc:`/{part.rpartition('.')[0]}`"
        else:
            parts[i] = f"``{part}``"
    return re.sub(LIST, r"\1\\", "".join(parts), flags=re.MULTILINE)


def indented(lines):
    return textwrap.indent("\n".join(lines), "    ").split("\n")


def indentation(line):
    return len(line) - len(line.lstrip())


def blocks(lines):
    """Runs of lines without an empty one between them."""
    found, block = [], []
    for line in [*lines, ""]:
        if line.strip():
            block.append(line)
        elif block:
            found.append(block)
            block = []
    return found


def render(lines, names=frozenset()):
    """reStructuredText of a docstring, or of a part of it, whose lines begin at the first column."""
    result = []
    remaining = blocks(lines)
    while remaining:
        block = remaining.pop(0)
        first = block[0].rstrip()
        if found := HEADER.match(first):
            end = next((i for i, line in enumerate(block[1:], 1) if HEADER.match(line)), len(block))
            if block[end:]:
                remaining.insert(0, block[end:])
            body = [*([f"    {found[2]}"] if found[2] else []), *block[1:end]]
            while not block[end:] and remaining and indentation(remaining[0][0]) >= 4:
                body += ["", *remaining.pop(0)]
            result += section(found[1], body, names)
        elif indentation(first):
            while remaining and indentation(remaining[0][0]):
                block += ["", *remaining.pop(0)]
            block = textwrap.dedent("\n".join(block)).split("\n")
            if formulas.is_formula(block):
                result += [".. math::", "", f"    {formulas.latex([line for line in block if line])}"]
            else:
                result += ["::", "", *indented(block)]
        elif first.startswith((">>>", "===")) or (len(block) > 1 and set(block[1]) <= set("-=~")):
            title = not first.startswith((">>>", "==="))
            result += [*block[:2], "", *render(block[2:])] if title else [re.sub(r" {3,}# ", "  # ", x) for x in block]
        else:
            result += paragraph(block)
        result.append("")
    return result


def paragraph(block):
    """Text, and what begins with a name in quotes as a list of definitions."""
    if block[0].startswith("* "):
        return inline("\n".join(block)).split("\n")
    text, items = [], []
    for line in block:
        named = re.match(r'("\w+"): ?(.*)', line)
        if named:
            items.append([named[1], [named[2]]])
        else:
            (items[-1][1] if items else text).append(line.strip())
    result = inline("\n".join(text)).split("\n") if text else []
    for name, about in items:
        result += ["", f"``{name}``", *indented(render(about))]
    return result


def section(name, body, names):
    """A field with a list of definitions; or with text, where nothing is named."""
    result, items = [f":{TITLES.get(name, name)}:"], []
    for line in textwrap.dedent("\n".join(body)).split("\n"):
        named = ITEM.match(line) if name != "References" else None
        if named:
            items += split(*named.groups(), names)
        elif items:
            items[-1][1].append(line)
        else:
            items.append(["", [line]])
    for title, (first, *rest) in items:
        text = render([first, *textwrap.dedent("\n".join(rest)).split("\n")])
        result += indented([f"**{inline(title)}**", *indented(text)] if title else text)
    return result


def split(title, text, names):
    """An item as several, where its line goes on with the next argument: "dt: in s. times: in s."."""
    for found in re.finditer(r"(?<=[.;] )(\w+(?:, \w+)*): ", text):
        if names.issuperset(found[1].split(", ")):
            return [[title, [text[: found.start()].strip(" ;")]], *split(found[1], text[found.end() :], names)]
    return [[title, [text]]]


def process(app, what, name, obj, options, lines):
    try:
        names = set(inspect.signature(obj).parameters)
    except (TypeError, ValueError):
        names = set()
    lines[:] = render(list(lines), names)


def is_field(app, what, name, obj, skip, options):
    """Fields of named tuples are in the docstring of the tuple."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def signature(app, what, name, obj, options, arguments, result):
    """A module as default value is shown by its name."""
    return re.sub(r"<module '([\w.]+)' from [^>]*>", r"\1", arguments or "") or None, result


def setup(app):
    app.connect("autodoc-process-docstring", process)
    app.connect("autodoc-skip-member", is_field)
    app.connect("autodoc-process-signature", signature)
    return {"parallel_read_safe": True}
