"""The coordinates in which a fit minimises, for optimisers of other packages."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from hhtjax.description import Array, PyTree
from hhtjax.description.presentation import shown
from hhtjax.identification.arguments import check_parameters, check_scale, check_transforms
from hhtjax.identification.parameter_vector import Coordinates


@shown
class Unconstrained(NamedTuple):
    """What `unconstrained` returns.

    Attributes:
        x0: (n,), the start: one number for each free parameter.
        params: x (n,) -> params, like params0; traceable and differentiable.
    """

    x0: Array
    params: Callable[[Array], PyTree]


def unconstrained(params0: PyTree, transforms: PyTree = None, scale: PyTree = None) -> Unconstrained:
    """Unbounded coordinates x for parameters with bounds, for optimisers that do not support bounds.

    Let an optimiser of optax, optimistix or SciPy change x, and compute the cost from `params(x)`. `fit` uses these
    coordinates by itself, also with an optax optimiser.

    Args:
        params0, transforms, scale: as in `fit`. x does not contain `fixed` parameters.

    Returns:
        An `Unconstrained`: the start x0, and the function from x to params.

    Raises:
        TypeError, ValueError: as `fit`, for these arguments; no free parameter.

    >>> import hhtjax
    >>> free = hhtjax.identification.unconstrained({"k": 2.0, "m": 1.0}, {"k": hhtjax.positive, "m": hhtjax.fixed})
    >>> free.x0.shape, {name: round(float(x), 3) for name, x in free.params(free.x0 + 1).items()}           # 2 e
    ((1,), {'k': 5.437, 'm': 1.0})
    """
    caller = "unconstrained"
    params0 = check_parameters(caller, params0)
    known = check_transforms(caller, transforms, params0)
    coordinates = Coordinates(known, params0, check_scale(caller, scale, params0))
    if not coordinates.free:
        raise ValueError(f"{caller}: `transforms` must leave a parameter free; received {transforms!r}.")
    return Unconstrained(coordinates.x0, coordinates.params)
