"""Which unknowns of a step are coupled: from the nodes of elements, from a pattern, or from what the functions read.

With the displacement x of a step and the variable eta of the velocity constraints, the equations of a step are

    r(w, L, eta) = [M w - Q - B^T L;  Phi;  B v + Phi_t],    x = (...) + beta h^2 w',    w = w' + D eta

in the unknowns (w', L, eta). eta enters velocities and accelerations, but no position. So it is coupled only to the
coordinates of its own constraint, and to those that dampers or a mass connect with these (see
`hhtjax.steppers.constrained`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from hhtjax.description import thaw
from hhtjax.jaxpr import TooDense, dependencies
from hhtjax.numerics.sparse_lu import Plan, plan
from hhtjax.numerics.sparsity import product, stacked, symmetric, union
from hhtjax.primitives import traced
from hhtjax.systems.elements import pairs_of

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from hhtjax.description import PyTree
    from hhtjax.systems.elements import Elements, Joints
    from hhtjax.systems.flat_system import FlatSystem


class Sparsity:
    """Sparsity patterns of a system on vectors.

    force: (n, n), of M w - Q. drag: of the part of it that depends on v and w. constraint: (m, n); None without
    constraints. turning: of `_turning`: the three numbers of a rotation are coupled.
    """

    def __init__(self, force: csr_array, drag: csr_array, constraint: csr_array | None, blocks: tuple):
        turning = _turning(force.shape[0], blocks)
        self.force, self.drag = (product(product(turning, symmetric(A)), turning) for A in (force, drag))
        self.constraint = None if constraint is None else product(constraint, turning)

    def of_rows(self) -> Plan:
        """The `Plan` of B B^T."""
        assert self.constraint is not None
        return plan(product(self.constraint, self.constraint.T.tocsr()))

    def plan(self, size: int) -> Plan:
        """The `Plan` for the unknowns w, (w, L) or (w, L, eta), which are distinguished by their number."""
        G, n = self.constraint, self.force.shape[0]
        if G is None or size == n:
            return plan(self.force)
        T = G.T.tocsr()
        A = union(self.force, product(T, G))
        if size == n + G.shape[0]:
            return plan(stacked([[A, T], [G, None]]), n)
        return plan(stacked([[A, T, product(self.drag, T)], [G, None, product(G, T)], [G, None, product(G, T)]]), n)


def _turning(n: int, blocks: tuple) -> csr_array:
    """(n, n): the identity, and full blocks for rotations."""
    from scipy.sparse import csr_array

    group = np.arange(n)
    for block in blocks:
        if block.is_rotation:
            here = np.arange(block.v.start, block.v.stop)
            group[here] = block.v.start + (here - block.v.start) // 3 * 3
    members = csr_array((np.ones(n, bool), (np.arange(n), group)), shape=(n, n))
    return product(members, members.T.tocsr())


def of_elements(parts: list[Elements], masses: list[Elements], joints: list[Joints], flat: FlatSystem, at: tuple):
    """The `Sparsity` of elements. at: shapes of q, v, t, params."""
    q, v, t, params = at
    n = flat.positions
    clouds = [_pairs(part.dofs(v), n) for part in (*parts, *masses)] or [_pairs(np.zeros((1, 1), int), n)]
    damped = [_pairs(part.dofs(v), n) for part in masses]
    damped += [_pairs(part.dofs(v), n) for part in parts if _reads_velocity(part, q, v, t, params)]
    none = _pairs(np.zeros((1, 1), int), n)
    rows = None
    if joints:
        rows = _below([_joint_rows(joint, q, v, t, params, n) for joint in joints])
    return Sparsity(union(*clouds), union(none, *damped), rows, flat.blocks)


def _pairs(dofs: np.ndarray, n: int) -> csr_array:
    """(n, n): all unknowns in a row of dofs are coupled."""
    from scipy.sparse import csr_array

    rows, columns = pairs_of(dofs)
    return csr_array(csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=(n, n)) > 0)


def _reads_velocity(part: Elements, q: PyTree, v: PyTree, t: Any, params: PyTree) -> bool:
    """Whether its force depends on v."""
    reads = traced(lambda v, q, t, params: part(q, v, t, thaw(params)), v, q, t, params).reads(None)
    return any(reads[: len(jax.tree.leaves(v))])


def _joint_rows(joint: Joints, q: PyTree, v: PyTree, t: Any, params: PyTree, n: int) -> csr_array:
    """(J m, n): each row is coupled to the unknowns of its joint."""
    from scipy.sparse import csr_array

    dofs = joint.dofs(v)
    m = jax.eval_shape(lambda q, t, params: joint(q, t, thaw(params)), q, t, params).shape[0] // joint.count
    columns = np.repeat(dofs, m, axis=0)
    rows = np.repeat(np.arange(len(columns)), columns.shape[1])
    return csr_array((np.ones(len(rows), bool), (rows, columns.ravel())), shape=(len(columns), n))


def _below(patterns: list) -> csr_array:
    """The patterns stacked vertically."""
    return stacked([[pattern] for pattern in patterns])


def detected(flat: FlatSystem, params: PyTree, dtype: np.dtype, pattern: csr_array | None = None) -> Sparsity:
    """The `Sparsity` of a system from what its functions read. pattern: (n, n), used instead of what M w - Q reads."""
    length = flat.blocks[-1].q.stop if flat.blocks else flat.positions
    x, *at = (jax.ShapeDtypeStruct(shape, dtype) for shape in ((flat.size,), (length,), ()))
    at = *at, jax.eval_shape(lambda x: x, params)  # of which no value counts
    try:
        reads = pattern
        if reads is None:
            reads = dependencies(lambda x, q, t, p: flat.residual(flat.move(q, x), x, x, t, p), x, *at)
        drag = dependencies(lambda x, q, t, p: flat.residual(q, x, x, t, p), x, *at)
        rows = None
        if flat.num_constraints:
            rows = dependencies(lambda x, q, t, p: flat.constraint(flat.move(q, x), t, p), x, *at)
    except TooDense as error:
        raise ValueError(
            f"sparse_lu: the matrix of a step is not sparse, by what the functions read: {error}"
        ) from None
    if reads.shape != (flat.size, flat.size):
        raise ValueError(
            f"sparse_lu: `pattern` must have shape ({flat.size}, {flat.size}), for the numbers in v; received shape "
            f"{reads.shape}."
        )
    return Sparsity(reads, drag, rows, flat.blocks)
