"""Names in C for the leaves of a pytree: q["arm"]["angle"] is q_arm_angle, an array of numbers if it has a shape."""

import itertools
import re
from typing import NamedTuple

import jax
import numpy as np

RESERVED = {  # keywords of C and C++, and what compilers and the headers that are included define
    *("auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum"),
    *("extern", "float", "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return"),
    *("short", "signed", "sizeof", "static", "struct", "switch", "typedef", "union", "unsigned", "void"),
    *("volatile", "while", "_Alignas", "_Alignof", "_Atomic", "_Bool", "_Complex", "_Generic", "_Imaginary"),
    *("_Noreturn", "_Static_assert", "_Thread_local", "alignas", "alignof", "and", "and_eq", "asm", "bitand", "bitor"),
    *("bool", "catch", "char16_t", "char32_t", "char8_t", "class", "co_await", "co_return", "co_yield", "compl"),
    *("concept", "const_cast", "consteval", "constexpr", "constinit", "decltype", "delete", "dynamic_cast", "explicit"),
    *("export", "false", "friend", "mutable", "namespace", "new", "noexcept", "not", "not_eq", "nullptr", "operator"),
    *("or", "or_eq", "private", "protected", "public", "reinterpret_cast", "requires", "static_assert", "static_cast"),
    *("template", "this", "thread_local", "throw", "true", "try", "typeid", "typename", "typeof", "typeof_unqual"),
    *("using", "virtual", "wchar_t", "xor", "xor_eq", "HUGE_VAL", "INFINITY", "NAN", "NULL", "linux", "unix"),
    *("M_E", "M_LOG2E", "M_LOG10E", "M_LN2", "M_LN10", "M_PI", "M_PI_2", "M_PI_4", "M_1_PI", "M_2_PI", "M_2_SQRTPI"),
    *("M_SQRT2", "M_SQRT1_2", "HUGE_VALF", "HUGE_VALL", "SIZE_MAX", "MATH_ERRNO", "MATH_ERREXCEPT"),
}


class Field(NamedTuple):
    """A member of a struct: its name, and the shape of its numbers."""

    name: str
    shape: tuple

    @property
    def size(self):
        """How many numbers it holds."""
        return int(np.prod(self.shape, dtype=int))

    def places(self, struct):
        """C for each of them, given that of the struct with its dot or arrow."""
        return [f"{struct}{self.name}" if self.shape == () else f"{struct}{self.name}[{i}]" for i in range(self.size)]

    def declaration(self, real, unit=None):
        """In the struct, with its unit, and its shape where it has more than one axis."""
        size = f"[{self.size}]" if self.shape else ""
        shape = f"{' x '.join(map(str, self.shape))}, row by row" if len(self.shape) > 1 else None
        told = "; ".join(filter(None, (shape, unit)))
        return f"    {real} {self.name}{size};{f' /* {told} */' if told else ''}"


def fields(tree, prefix, alone):
    """A field for each leaf of a pytree. alone: the name of one that has no path."""
    return [
        Field(identifier([prefix, *map(_word, path)]) if path or prefix else alone, np.shape(leaf))
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    ]


def identifier(words):
    """Words, joined, as a name that C allows."""
    text = re.sub(r"\W", "_", "_".join(filter(None, words)), flags=re.ASCII)
    text = text if re.match(r"[A-Za-z]|_(?![A-Z_])", text) else f"p{text}"  # __LINE__ and _Bool are the compiler's
    return f"{text}_" if text in RESERVED else text


def units_of(caller, units, found):
    """{name of a field: its unit}, from those of fields, or of all whose names begin with such a word."""
    units = {} if units is None else units
    if not isinstance(units, dict) or not all(isinstance(x, str) for pair in units.items() for x in pair):
        raise TypeError(f"{caller}: `units` must be a dict of names and texts, as {{'q': 'rad'}}; received {units!r}.")
    if wrong := [text for text in units.values() if re.search(r"[*]/|/[*]|[^ -~\u00a1-\uffff]", text)]:
        raise ValueError(f"{caller}: `units` must fit into a comment of C; received {wrong[0]!r}.")
    told, read = {}, set()
    for name in (field.name for field in found):
        keys = [key for key in units if name == key or name.startswith(f"{key}_")]
        if keys:
            key = max(keys, key=len)
            told[name] = units[key]
            read.update(keys)
    if unknown := [key for key in units if key not in read]:
        names = ", ".join(field.name for field in found)
        raise ValueError(f"{caller}: `units` must name fields among {names}; received {unknown[0]!r}.")
    return told


def distinct(found, taken=()):
    """The fields, each with a name of its own: one that an earlier field has, or that is taken, gets a number."""
    own, given, result = {field.name for field in found}, set(taken), []
    for field in found:
        numbered = (f"{field.name}_{i}" for i in itertools.count(2))
        free = (name for name in numbered if name not in given | own)
        result.append(field._replace(name=next(free) if field.name in given else field.name))
        given.add(result[-1].name)
    return result


def _word(key):
    return str(next(getattr(key, name) for name in ("key", "idx", "name") if hasattr(key, name)))
