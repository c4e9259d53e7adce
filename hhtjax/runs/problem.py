"""What a run starts from: the checks of what a user hands over, and the same on vectors."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from hhtjax.checks import require_number, require_params
from hhtjax.description import is_concrete, thaw
from hhtjax.steppers.stepper import require_capable, require_stepper, require_system
from hhtjax.systems import held
from hhtjax.systems.consistent import require_consistent
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.initial_values import initial_values
from hhtjax.systems.rubbing import with_known_rows
from hhtjax.systems.system import require_masses


class Problem(NamedTuple):
    """A system, how to step it, and from where; params hold no functions, as `freeze` leaves them. output: an `Output`,
    where a run saves that in place of its path."""

    system: Any
    stepper: Any
    q0: Any
    v0: Any
    params: Any
    t0: Any
    z0: Any
    output: Any = None

    @classmethod
    def checked(cls, caller, system, stepper, q0, v0, params, t0, z0):
        """The same of what a user hands over, or an error that names what is wrong with it."""
        require_system(caller, system, massless=True)
        require_stepper(caller, stepper)
        params = require_params(caller, params)
        if held.holds(params):
            require_masses(caller, system, "leave out held inputs, sampled(order=0)")
        _refuse_checked_axes(caller, q0, v0, params, t0, z0)
        require_number(caller, "t0", t0, np.isfinite, "be finite")
        q0, v0, z0 = initial_values(caller, system, q0, v0, z0, level=4)
        require_capable(caller, system, stepper, q0, v0)
        if system.friction is not None:
            system = with_known_rows(caller, system, q0, v0, t0, params, z0)
        if system.constraint is not None:
            require_consistent(caller, system, q0, v0, t0, params, stepper.redundant, z0)
        t0 = float(t0) if is_concrete(t0) else t0  # other number types would be compiled anew
        return cls(system, stepper, q0, v0, params, t0, z0)

    def rates(self):
        """How many there are, of coordinates: a rotation has three, and nine numbers."""
        return sum(map(jnp.size, jax.tree.leaves(self.q0 if self.v0 is None else self.v0)))

    def times(self, t):
        """Times in the dtype of the state."""
        return jnp.asarray(t).astype(jax.tree.leaves(self.q0)[0].dtype)

    def flat(self):
        """The system on vectors, q, v, t0 and the params."""
        params = thaw(self.params)
        flat, q, v = flatten("simulate", self.system, self.q0, self.v0, self.t0, params, self.z0)
        return flat, q, v, self.times(self.t0), params


def _refuse_checked_axes(caller, *args):
    """Under `check_vma` of `jax.shard_map` each array says over which axes it varies. Constants must say so too, and
    those of loops, branches and Jacobians do not here."""
    for x in jax.tree.leaves(args):
        kind = getattr(jax.typeof(x), "mat", None) if isinstance(x, Tracer) else None
        if kind is not None and kind.varying:
            raise TypeError(
                f"{caller}: inside `jax.shard_map` with check_vma=True, its default; received arguments that vary over "
                f"the axes {sorted(kind.varying)}. Write jax.shard_map(..., check_vma=False): the values are the same. "
                "`sweep` spreads its members over devices by itself."
            )
