"""A reported problem: a script as its user would write it, the right answer, and what came out."""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple


class Case(NamedTuple):
    """One problem.

    Attributes:
        what: in words.
        script: a function of no arguments, that returns a number or a text.
        right: the number, or what the text must hold.
        within: by how much a number may differ from it.
        is_long: whether it takes minutes, so that smoke runs leave it out.
    """

    what: str
    script: Callable[[], Any]
    right: Any
    within: float = 0.0
    is_long: bool = False

    def holds(self, found):
        """Whether that is the right answer."""
        if isinstance(self.right, str):
            return isinstance(found, str) and self.right in found
        return not isinstance(found, str) and abs(found - self.right) <= self.within


def answer(script):
    """What a script gives: a number; or a text, that of its error if it raises one, or of its first warning."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            found = script()
        except Exception as error:  # the message is the answer
            return f"{type(error).__name__}: {error}".splitlines()[0]
    if told and isinstance(found, str):
        return f"{found}; warns: {told[0].message}".splitlines()[0]
    return found if isinstance(found, str) else float(found)
