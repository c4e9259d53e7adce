"""diffrax on the scenes of this library, imported only where it is asked for: it belongs to the extra `peers`."""

import importlib

import jax.numpy as jnp


def solve(scene, solver, params, duration, **options):
    """The solution of q' = v, v' = M^-1 Q by the solver of that name, with step-size control."""
    diffrax = importlib.import_module("diffrax")

    def rate(t, y, params):
        q, v = y
        return v, jnp.linalg.solve(scene.system.mass(q, params), scene.system.force(q, v, t, params))

    return diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        getattr(diffrax, solver)(),
        0.0,
        duration,
        None,
        (scene.q0, scene.v0),
        params,
        stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-9),
        **options,
    )
