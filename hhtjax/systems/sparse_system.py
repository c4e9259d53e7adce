"""Linear systems whose matrices stay sparse, or diagonal: what that asks for, and where there is none."""

from hhtjax.numerics.sparse_matrix import Sparse
from hhtjax.systems.linear_system import LinearSystem
from hhtjax.systems.matrices import as_matrix
from hhtjax.systems.returned import evaluate


def shapes_of_matrices(caller, system, params):
    """Of the matrices that a linear system has, by name: what they are, or what their functions return."""
    given = {name: A for name in "MCK" if (A := getattr(system, name)) is not None}
    return {name: evaluate(caller, name, A, params) if callable(A) else A for name, A in given.items()}


def require_dense(caller, system, params):
    """An error for a linear system with sparse matrices."""
    if isinstance(system, LinearSystem):
        for name, A in shapes_of_matrices(caller, system, params).items():
            if isinstance(A, Sparse):
                raise NotImplementedError(
                    f"{caller}: `{name}` must be an array; received a sparse matrix of {len(A)} rows: "
                    "hhtjax.analysis.modal_reduction reduces a system to its lowest modes, K.toarray() makes an array."
                )


def with_known_matrices(caller, system, flat, on_vectors, dtype, params):
    """The flat system as one that keeps its matrices sparse, or diagonal, where they are.

    on_vectors: makes the flat system of a `LinearSystem`.
    """
    shapes = shapes_of_matrices(caller, system, params)

    def matrices(params):
        given = {name: getattr(system, name) for name in shapes}
        found = {name: as_matrix(A(params) if callable(A) else A, dtype) for name, A in given.items()}
        return [found.get(name) for name in "MCK"]

    if not any(isinstance(A, Sparse) for A in shapes.values()):
        are_diagonal = all(len(A.shape) == 1 for A in shapes.values())
        return _knowing(flat, diagonals=matrices) if are_diagonal else flat
    _require_sparse(caller, system, shapes)

    def settle(params):
        known = matrices(params)
        return _knowing(on_vectors(system.with_matrices(*known)), matrices=lambda params: known)

    return _knowing(flat, matrices=matrices)._replace(settle=settle)


def _require_sparse(caller, system, shapes):
    """An error for what does not go with sparse matrices."""
    for name, A in shapes.items():
        if not isinstance(A, Sparse) and len(A.shape) > 1:
            raise ValueError(
                f"{caller}: `{name}` must be sparse, too, or a diagonal (n,), beside a sparse matrix: "
                f"hhtjax.sparse makes one; received shape {A.shape}."
            )
    if system.friction is not None:
        raise NotImplementedError(f"{caller}: leave out `friction` beside sparse matrices, or hand over dense ones.")
    if system.nonlinear is not None and system.at is None:
        raise NotImplementedError(f"{caller}: name the coordinates of `nonlinear` by `at`: the matrices are sparse.")


def _knowing(flat, **matrices):
    """The system, and its linear part, with this function for its matrices."""
    local = None if flat.local is None else flat.local._replace(linear=flat.local.linear._replace(**matrices))
    return flat._replace(**matrices, local=local)
