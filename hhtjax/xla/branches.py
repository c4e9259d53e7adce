"""A conditional in a batch, differentiated before it is batched: a rule that JAX does not have.

Where members of a batch take different branches, JAX evaluates both, and keeps what a member did not ask for away from
derivatives by `stop_gradient`. A derivative that is made before the batch, as by the rule of `numerics.counted_loop`,
has that on its tangents, and reverse mode asks for its transpose. That is zero: such a tangent has no influence.
"""

import jax
import numpy as np
from jax import lax
from jax.interpreters import ad


def let_branches_be_transposed():
    """Gives `stop_gradient` a transpose, unless JAX has one, or `stop_gradient` is no primitive."""
    for eqn in jax.make_jaxpr(lax.stop_gradient)(jax.ShapeDtypeStruct((), np.float32)).eqns:
        ad.primitive_transposes.setdefault(eqn.primitive, lambda _, x: (ad.Zero(x.aval),))
