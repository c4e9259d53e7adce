"""Linear systems whose matrices stay sparse: what that asks for, and where there is none."""

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


def with_sparse_matrices(caller, system, flat, on_vectors, dtype, params):
    """The flat system as one whose matrices are kept sparse, if one is; on_vectors makes the flat one of a system."""
    shapes = shapes_of_matrices(caller, system, params)
    if not any(isinstance(A, Sparse) for A in shapes.values()):
        return flat
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

    def matrices(params):
        given = {name: getattr(system, name) for name in shapes}
        found = {name: as_matrix(A(params) if callable(A) else A, dtype) for name, A in given.items()}
        return [found.get(name) for name in "MCK"]

    def settle(params):
        known = matrices(params)
        return _knowing(on_vectors(system.with_matrices(*known)), lambda params: known)

    return _knowing(flat, matrices)._replace(settle=settle)


def _knowing(flat, matrices):
    """The system, and its linear part, with this function for its matrices."""
    local = None if flat.local is None else flat.local._replace(linear=flat.local.linear._replace(matrices=matrices))
    return flat._replace(matrices=matrices, local=local)
