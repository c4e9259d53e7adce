"""Evaluation of the records of a fit by the workers of an executor, or by the devices of a mesh.

Levenberg-Marquardt needs only the triangle R of [J r] = Q R of each record, not the rows of J and r. So the rows stay
on the workers, and R is returned, a square matrix of k + p + 1 columns, where k is the number of the record's own
unknowns and p that of the shared ones. The rows are collected once, at the minimum, for the standard errors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from hhtjax.description import Array, PyTree, programs
from hhtjax.identification.arguments import Options
from hhtjax.identification.bordered_least_squares import Arrow, ArrowTrial, arrow_trial
from hhtjax.identification.gauss_newton import Seen
from hhtjax.identification.losses import Objective
from hhtjax.identification.parameter_vector import Coordinates, Data, record_parts
from hhtjax.identification.problem import HostRecords
from hhtjax.runs.executors import Chunks, Hands, Work, collected, sent

if TYPE_CHECKING:
    from hhtjax.description.current import Reading


class Many(NamedTuple):
    """The workers or devices that evaluate records. chunk: number of records in a task of an executor."""

    hands: Hands | None
    mesh: Mesh | None
    chunk: int

    def problem(
        self, residuals: Callable | Reading, options: Options, params0: PyTree, data: Data, w: np.ndarray, p: int
    ) -> ManyRecords:
        """The least-squares problem."""
        shared, records = data._replace(weights=True, records=None, starts=None), (data.starts, data.records)
        structure = jax.tree.structure((params0, shared, records))
        given = [sent(x) for x in jax.tree.leaves((params0, shared))]
        of_records = [w, *(np.asarray(x) for x in jax.tree.leaves(records))]
        triangles, rows = (
            self._evaluated(_Records(residuals, options, structure, of_rows), given, of_records, len(w), p)
            for of_rows in (False, True)
        )
        return ManyRecords(triangles, rows, p, w.shape)

    def _evaluated(self, f: _Records, shared: list, of_records: list, count: int, p: int) -> Callable:
        """The function x -> results for all records."""

        def own_at(x: np.ndarray, members: np.ndarray) -> list:
            return [x[:p], x[p:].reshape(count, -1)[members], *(y[members] for y in of_records)]

        if self.mesh is None:
            chunks = Chunks.of(count, self.chunk)
        else:  # one, a whole number of records for each device
            chunks = Chunks(count, -(-count // self.mesh.size) * self.mesh.size)
        packed: list = []  # the program, which is the same for all x

        def at(x: np.ndarray) -> PyTree:
            work = Work(f, shared, partial(own_at, x), chunks, {})
            if self.mesh is not None:
                found = _on_mesh(f, self.mesh, shared, work.arrays(0))
                return jax.tree.map(lambda y: np.asarray(y)[:count], found)
            if not packed:
                packed.append(work.packed("fit"))
            return collected(work, self.hands, program=packed[0])

        return at


@dataclass(frozen=True)
class _Records:
    """Evaluates some records at x: their triangles, or with `rows` their residuals and Jacobians."""

    residuals: Callable | Reading
    options: Options
    structure: Any
    rows: bool

    def __call__(self, shared: list, own: list) -> dict[str, Any]:
        x, own_x, w, *records = own
        params0, data, (starts, records) = jax.tree.unflatten(self.structure, [*shared, *records])
        data = data._replace(starts=starts, records=records)
        coordinates = Coordinates(self.options.transforms, params0, data.scale)
        parts = record_parts(self.residuals, coordinates, data, at_least=0)  # there may be few records here
        objective = Objective(w.ravel(), self.options.loss, w.size)
        problem = Arrow(parts.f, objective, records, x.size, coordinates.bend())
        both = jnp.concatenate([x, own_x.ravel()])
        read = problem.read(both)
        if self.rows:
            return dict(zip(("r", "J", "J_own"), read, strict=True))
        seen = problem.seen(both, *read)
        cost = jnp.sum(objective.losses(read[0].ravel())[0].reshape(w.shape), axis=1) / 2
        bend = () if seen.bend is None else jnp.broadcast_to(seen.bend, (len(w), x.size))
        return {"R": triangles(seen), "cost": cost, "bend": bend}


def triangles(seen: Seen) -> Array:
    """R of [J r] = Q R of each record."""
    return jnp.linalg.qr(jnp.concatenate([seen.J, seen.r[:, :, None]], axis=2), mode="r")


class ManyRecords(NamedTuple):
    """An `Arrow` problem whose records are evaluated by workers or devices.

    triangles: x -> triangles of all records. read: x -> their residuals and Jacobians.
    """

    triangles: Callable
    read: Callable
    p: int
    shape: tuple  # records, residuals of one

    @property
    def count(self) -> int:
        """Number of records."""
        return self.shape[0]

    def look(self, x: np.ndarray, D: np.ndarray) -> ArrowTrial:
        """The trial at x, with D from the trials before."""
        found = self.triangles(x)
        R, bend = found["R"], found["bend"]
        bend = None if isinstance(bend, tuple) else bend[0]
        so_many = np.broadcast_to(np.zeros((), R.dtype), self.shape)  # residuals, which are not here
        seen = Seen(R[:, :, -1], R[:, :, :-1], np.sum(found["cost"]), bend, (so_many, None, None))
        return arrow_trial(x, seen, D, self.p)

    def rows(self, x: np.ndarray) -> tuple:
        """Residuals and their derivatives."""
        found = self.read(x)
        return found["r"], found["J"], found["J_own"]

    def bending(self, now: ArrowTrial, new: ArrowTrial, at: ArrowTrial, step: np.ndarray) -> np.ndarray:
        """0: no geodesic acceleration, which would need the rows."""
        return 0 * step

    nothing = HostRecords.nothing
    step, damped, length, cosine, offset = Arrow.step, Arrow.damped, Arrow.length, Arrow.cosine, Arrow.offset


@partial(jax.jit, static_argnums=(0, 1))
def _on_mesh(f: _Records, mesh: Mesh, shared: list, own: list) -> PyTree:
    """f of all records; each device evaluates its part."""
    x, *of_records = own
    spread, same = PartitionSpec(mesh.axis_names), PartitionSpec()
    parts = jax.shard_map(
        lambda shared, x, rest: f(shared, [x, *rest]),
        mesh=mesh,
        in_specs=(same, same, spread),
        out_specs=spread,
        check_vma=False,
    )
    return parts(shared, x, of_records)


programs.add(_on_mesh)
