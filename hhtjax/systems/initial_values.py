"""Initial values: the checks of what a user hands over."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import describe
from hhtjax.description import is_array, is_concrete, is_real
from hhtjax.systems import kinematics
from hhtjax.systems.system import FirstOrderSystem

ORTHOGONAL = 1e-6  # largest entry of R^T R - I that passes for a rotation; 100 roundings in float32


class PrecisionWarning(UserWarning):
    """The state is in single precision."""


def initial_values(caller, system, q0, v0, z0=None, level=3):
    """q0, v0 and z0 as arrays of one float dtype, checked; those that the system does not have are None."""
    first_order = isinstance(system, FirstOrderSystem)
    if first_order:
        if v0 is not None:
            raise ValueError(f"{caller}: `v0` must be left out for a FirstOrderSystem; received {v0!r}.")
        v0 = q0
    _require_internal(caller, system, z0)
    if not sum(np.size(x) for x in jax.tree.leaves(q0)):
        raise ValueError(f"{caller}: `q0` must hold at least one number; received {q0!r}.")
    structure = jax.tree.structure(q0)
    if jax.tree.structure(v0) != structure:
        raise ValueError(
            f"{caller}: `v0` must be a pytree structured like q0, {structure}; received {jax.tree.structure(v0)}."
        )
    dtypes = set()
    for name, values in (("q0", q0), ("v0", v0), ("z0", z0)):
        for path, leaf in jax.tree_util.tree_leaves_with_path(values):
            dtype = _require_finite(f"{caller}: `{name}{jax.tree_util.keystr(path)}`", leaf)
            if is_array(leaf) and jnp.issubdtype(dtype, jnp.floating):
                dtypes.add(jnp.result_type(leaf))  # what JAX makes of it: float32 without x64
    for (path, q), v in zip(jax.tree_util.tree_leaves_with_path(q0), jax.tree.leaves(v0), strict=True):
        if kinematics.is_rotation(jnp.shape(q), jnp.shape(v)):
            _require_rotations(f"{caller}: `q0{jax.tree_util.keystr(path)}`", q)
        elif jnp.shape(q) != jnp.shape(v):
            a, b = jnp.shape(q), jnp.shape(v)
            turns = a[-2:] == (3, 3) or (a[-1:], b[-1:]) == ((4,), (3,))  # or is a quaternion
            rotation = ", but (3,) for a rotation, a matrix (3, 3)" if turns else ""
            raise ValueError(
                f"{caller}: `v0` must have the shapes of q0, {describe(q0)}{rotation}; received {describe(v0)}."
            )
    dtype = _the_one(caller, dtypes, q0, v0, z0) if dtypes else jnp.result_type(float)
    if dtype == jnp.float32:
        warnings.warn(
            f"{caller}: in float32 expect about 4 correct digits at best, fewer on stiff systems and small steps: "
            "for float64 call jax.config.update('jax_enable_x64', True) before creating arrays.",
            PrecisionWarning,
            stacklevel=level,
        )
    q0, v0, z0 = (jax.tree.map(lambda x: jnp.asarray(x, dtype), values) for values in (q0, v0, z0))
    return q0, None if first_order else v0, z0


def _the_one(caller, dtypes, q0, v0, z0):
    """The dtype that all share, or an error."""
    if len(dtypes) > 1:
        names = "`q0` and `v0`" if z0 is None else "`q0`, `v0` and `z0`"
        received = " and ".join(describe(x) for x in (q0, v0, z0) if x is not None)
        raise TypeError(f"{caller}: {names} must share one dtype; received {received}.")
    return dtypes.pop()


def _require_internal(caller, system, z0):
    """An error for a z0 that is missing, or that the system has no use for."""
    if system.internal is None:
        if z0 is not None:
            raise ValueError(f"{caller}: leave `z0` out: the system has no internal states; received {z0!r}.")
    elif z0 is None:
        raise ValueError(f"{caller}: `z0` must be given: the system has internal states.")
    elif not sum(np.size(x) for x in jax.tree.leaves(z0)):
        raise ValueError(f"{caller}: `z0` must hold at least one number; received {z0!r}.")


def _require_finite(where, leaf):
    """The dtype of a leaf, or an error for what is no array of finite numbers of single or double precision."""
    if not is_array(leaf) and (isinstance(leaf, bool) or not isinstance(leaf, (int, float, complex))):
        raise TypeError(f"{where} must be an array or a number; received {leaf!r}.")
    dtype = getattr(leaf, "dtype", None) or np.result_type(leaf)
    if not is_real(leaf) or dtype in (jnp.float16, jnp.bfloat16):
        raise TypeError(f"{where} must be float32 or float64; received {dtype}.")
    if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
        raise ValueError(f"{where} must be finite; received {leaf!r}.")
    return dtype


def _require_rotations(where, R):
    """An error for matrices that are not orthogonal, or are reflections; tracers pass."""
    if not is_concrete(R):
        return
    R = np.asarray(R)
    tolerance = max(ORTHOGONAL, 100 * np.finfo(R.dtype).eps) if R.dtype.kind == "f" else ORTHOGONAL
    error = np.max(np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)), initial=0)
    if error > tolerance:
        raise ValueError(
            f"{where} must be a rotation, because its velocity has 3 components; received a matrix R whose "
            f"R^T R differs from I by {error:.3g}: hhtjax.rotation.exp(psi) gives rotations."
        )
    if np.any(np.linalg.det(R) < 0):
        raise ValueError(f"{where} must be a rotation; received a reflection, det R = -1.")
