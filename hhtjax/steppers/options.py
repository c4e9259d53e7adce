"""The options of the generalised-alpha family: names, kinds, defaults and checks."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache, wraps
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar, get_args, get_type_hints

import jax

from hhtjax.checks import require_function, require_integer, require_number
from hhtjax.description import Real
from hhtjax.numerics.linear_solve import Structured
from hhtjax.systems.constraints import check_redundant

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Stepper

Constructor = TypeVar("Constructor", bound=Callable)


@dataclass(frozen=True)
class Options:
    """How the residual is solved; `hht` documents the fields. Editors find them because constructors pass them on."""

    iterations: int | None = 1
    linearize: Literal["predictor", "held", "state", "auto"] | None = None
    tolerance: float = 1e-10
    max_iterations: int = 20
    start: Literal["smooth", "corrected", "simple"] | None = None
    formulation: Literal["ggl", "index3"] = "ggl"
    redundant: Literal["least_squares"] | None = None
    kinematics: Literal["chart", "lie"] = "chart"
    solve: Callable | None = None


OPTIONS = [field.name for field in fields(Options)]
jax.tree_util.register_dataclass(Options, OPTIONS, [])


class Keywords(TypedDict, total=False):
    """`Options` for type checkers, which cannot derive them from the class (a test compares both)."""

    iterations: int | None
    linearize: Literal["predictor", "held", "state", "auto"] | None
    tolerance: float
    max_iterations: int
    start: Literal["smooth", "corrected", "simple"] | None
    formulation: Literal["ggl", "index3"]
    redundant: Literal["least_squares"] | None
    kinematics: Literal["chart", "lie"]
    solve: Callable | None


def takes_options(constructor: Constructor) -> Constructor:
    """Gives a constructor these options as its `**options`: help() and completion list them, and an unknown name is an
    error."""
    name, own = constructor.__name__, inspect.signature(constructor)
    kinds = get_type_hints(Options)

    @wraps(constructor)
    def checked(*arguments: Real, **keywords) -> Stepper:
        for given in keywords:
            if given not in own.parameters and given not in OPTIONS:
                raise TypeError(f"{name}: unknown option {given!r}; the options are {', '.join(OPTIONS)}.")
        return constructor(*arguments, **keywords)

    listed = (
        inspect.Parameter(x.name, inspect.Parameter.KEYWORD_ONLY, default=x.default, annotation=kinds[x.name])
        for x in fields(Options)
    )
    first = [x for x in own.parameters.values() if x.kind is not inspect.Parameter.VAR_KEYWORD]
    checked.__signature__ = own.replace(parameters=[*first, *listed])  # pyright: ignore[reportAttributeAccessIssue]
    return checked  # pyright: ignore[reportReturnType]


def check_options(caller: str, **keywords: Any) -> Options:
    """`Options` with the default of `linearize` filled in; raises an error that names a wrong value."""
    options = Options(**keywords)
    if options.iterations is not None:
        options = replace(options, iterations=require_integer(caller, "iterations", options.iterations))
    if options.linearize is None:
        options = replace(options, linearize="auto" if options.iterations == 1 else "predictor")
    _require_one_of(caller, "linearize", options)
    if options.iterations is None and options.linearize != "predictor":
        raise ValueError(
            f"{caller}: with iterations=None, Newton starts from the predictor: leave `linearize` out; "
            f"received {options.linearize!r}."
        )
    require_number(caller, "tolerance", options.tolerance, lambda x: x > 0, "be positive")
    options = replace(options, max_iterations=require_integer(caller, "max_iterations", options.max_iterations))
    for name in ("start", "formulation", "kinematics"):
        _require_one_of(caller, name, options)
    if options.redundant is not None:
        check_redundant(caller, options.redundant)
        if options.solve is not None:
            raise ValueError(f"{caller}: `redundant` brings its own solver: leave out `solve`, or `redundant`.")
    if options.solve is not None:
        structured = isinstance(options.solve, Structured)
        require_function(caller, "solve", options.solve, "solve(...)" if structured else "solve(A, b)")
    return options


@cache
def _words(name: str):
    """The allowed values of an option, from its annotation. Reading annotations takes long, so the result is kept."""
    kind = get_type_hints(Options)[name]
    optional = type(None) in get_args(kind)
    return (*get_args(get_args(kind)[0] if optional else kind), *((None,) if optional else ()))


def _require_one_of(caller: str, name: str, options: Options):
    value, allowed = getattr(options, name), _words(name)
    if value not in allowed:
        words = [word for word in allowed if word is not None]
        *others, last = (f'"{word}"' for word in words)
        raise ValueError(f"{caller}: `{name}` must be {', '.join(others)} or {last}; received {value!r}.")


def require_alpha(caller: str, alpha: Real) -> Real:
    """Returns HHT's alpha if it lies in its range."""
    return require_number(caller, "alpha", alpha, lambda x: -1 / 3 - 1e-12 <= x <= 0, "lie in [-1/3, 0]")
