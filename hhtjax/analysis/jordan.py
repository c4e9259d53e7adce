"""Multiple eigenvalues, and what powers of a matrix do before they decay."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhtjax.analysis.amplification import require_matrix
from hhtjax.checks import require_integer, require_number
from hhtjax.description import Real


class Eigenvalue(NamedTuple):
    """An eigenvalue, and how many eigenvectors belong to it.

    Attributes:
        value: a complex number.
        blocks: the sizes of its Jordan blocks, the largest first. Only blocks of 1: as many eigenvectors.
    """

    value: complex
    blocks: tuple[int, ...]


def jordan_structure(matrix: Real, tolerance: Real = 1e-3) -> tuple[Eigenvalue, ...]:
    """The distinct eigenvalues with their Jordan blocks, the largest modulus first; NumPy, on concrete values.

    Rounding scatters an eigenvalue with a block of size k by a k-th root of itself, but not the mean of what it
    becomes. Eigenvalues closer than `tolerance` count as one, their mean mu, and the ranks of (A - mu I)^j tell the
    blocks; a singular value counts as zero below tolerance^2 times the largest possible.

    Args:
        matrix: real, (n, n).
        tolerance: relative to the largest entry of the scaled matrix, in (0, 1).

    Returns:
        A tuple of `Eigenvalue`.

    Raises:
        TypeError, ValueError: no real square matrix; a tolerance that is not in (0, 1); eigenvalues within the
            tolerance of each other that the ranks do not confirm as one.

    >>> A = [[2.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]
    >>> [(round(x.value.real, 6), x.blocks) for x in jordan_structure(A)]
    [(2.0, (2, 1))]
    """
    A = require_matrix("jordan_structure", matrix)
    require_number("jordan_structure", "tolerance", tolerance, lambda x: 0 < x < 1, "lie in (0, 1)")
    found, values = [], list(np.linalg.eigvals(A))
    while values:
        cluster = [max(values, key=abs)]
        for x in cluster:  # grows as it goes: neighbours of neighbours
            near = [y for y in values if abs(y - x) <= tolerance * max(1, abs(x)) and y not in cluster]
            cluster += near
        members = [x for x in values if x in cluster]
        values = [x for x in values if x not in cluster]
        found.append(Eigenvalue(complex(np.mean(members)), _blocks(A, members, tolerance)))
    return tuple(found)


def _blocks(A: np.ndarray, members: list, tolerance: Real):
    N = A - np.mean(members) * np.eye(len(A))
    nullities, power = [0], np.eye(len(A))
    while nullities[-1] < len(members) and len(nullities) <= len(members):
        power = power @ N
        small = tolerance**2 * np.linalg.norm(N, 2) ** len(nullities)
        nullities.append(int(np.sum(np.linalg.svd(power, compute_uv=False) <= small)))
    at_least = np.diff(nullities)  # number of blocks of size 1, 2, ... and more
    if nullities[-1] != len(members) or np.any(np.diff(at_least) > 0):
        raise ValueError(
            f"jordan_structure: the eigenvalues {np.array(members)} lie within tolerance={tolerance:g} of each other, "
            "but are not one; take a smaller tolerance."
        )
    return tuple(int(np.sum(at_least > i)) for i in range(at_least[0]))


def transient_growth(matrix: Real, num_steps: int, near: Real = None) -> np.ndarray:
    """|D23| of Cardona, Geradin (1989), Fig. 1, from the powers of A, for n = 0 .. num_steps: (num_steps + 1,).

    What A^n does in the invariant subspace of an eigenvalue mu beyond multiplying by mu^n, relative to the first step:
    |A^n - mu^n I|/|A - mu I| there. For Jordan blocks of size 2 this is n |mu|^(n-1), which peaks near n = -1/ln|mu|;
    without a block it is zero.

    Args:
        matrix: A, real, (n, n). num_steps: the last n.
        near: mu is the eigenvalue nearest to it, by default the largest.

    Returns:
        (num_steps + 1,).

    Raises:
        TypeError, ValueError: as `jordan_structure`; a num_steps that is not a positive integer.

    >>> import hhtjax
    >>> A = hhtjax.analysis.constraint_matrix(hhtjax.hht(alpha=-0.1, formulation="index3"))
    >>> growth = transient_growth(A, 20)
    >>> int(growth.argmax()), round(float(growth.max()), 3)
    (5, 2.241)
    """
    A = require_matrix("transient_growth", matrix)
    num_steps = require_integer("transient_growth", "num_steps", num_steps)
    found = jordan_structure(A)
    value, blocks = found[0] if near is None else min(found, key=lambda x: abs(x.value - near))
    if blocks[0] == 1:
        return np.zeros(num_steps + 1)
    N = A - value * np.eye(len(A))
    _, _, Vh = np.linalg.svd(np.linalg.matrix_power(N, blocks[0]))
    V = Vh[-sum(blocks) :].conj().T  # an orthonormal basis of the invariant subspace
    growth, x = np.zeros(num_steps + 1), V
    for n in range(1, num_steps + 1):
        x = A @ x
        growth[n] = np.linalg.norm(V.conj().T @ x - value**n * np.eye(V.shape[1]), 2)
    return growth / growth[1]
