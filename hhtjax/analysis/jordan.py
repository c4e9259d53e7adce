"""Multiple eigenvalues, and the growth of the powers of a matrix before they decay."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhtjax.analysis.amplification import require_matrix
from hhtjax.checks import require_integer, require_number
from hhtjax.description import Real


class Eigenvalue(NamedTuple):
    """An eigenvalue, and the sizes of its Jordan blocks.

    Attributes:
        value: a complex number.
        blocks: sizes of its Jordan blocks, largest first. Each block has one eigenvector.
    """

    value: complex
    blocks: tuple[int, ...]


def jordan_structure(matrix: Real, tolerance: Real = 1e-3) -> tuple[Eigenvalue, ...]:
    """The distinct eigenvalues with their Jordan blocks, largest modulus first. It uses NumPy and needs concrete
    values.

    Rounding splits an eigenvalue with a block of size k into several, at a distance of about the k-th root of rounding.
    Their mean is accurate. So eigenvalues closer than `tolerance` count as one, with their mean mu as value. The ranks
    of (A - mu I)^j give the sizes of the blocks. A singular value counts as zero if it is below tolerance^2 times the
    largest possible one.

    Args:
        matrix: real, (n, n).
        tolerance: in (0, 1); relative to the modulus of the eigenvalue, or to 1 if that is larger.

    Returns:
        A tuple of `Eigenvalue`.

    Raises:
        TypeError, ValueError: not a real square matrix; a tolerance that is not in (0, 1); eigenvalues within the
            tolerance of each other that are distinct according to the ranks.

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
    """The growth that a Jordan block of A causes over n = 0 .. num_steps steps: (num_steps + 1,).

    It is |A^n - mu^n I|/|A - mu I| in the invariant subspace of an eigenvalue mu: the part of A^n beyond multiplication
    by mu^n, relative to the first step. For Jordan blocks of size 2 this is n |mu|^(n-1), which peaks near
    n = -1/ln|mu|. Without a block it is zero. This is |D23| of Cardona, Geradin (1989), Fig. 1.

    Args:
        matrix: A, real, (n, n). num_steps: the last n.
        near: mu is the eigenvalue nearest to this number; None: the eigenvalue of largest modulus.

    Returns:
        (num_steps + 1,).

    Raises:
        TypeError, ValueError: as `jordan_structure`; num_steps is not a positive integer.

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
