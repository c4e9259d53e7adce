"""diffrax on the scenes of this library, imported only where it is asked for: it belongs to the extra `interop`."""

import importlib

import hhtjax


def solve(scene, solver, params, duration, **options):
    """The solution of q' = v, v' = M^-1 Q by the solver of that name, with step-size control."""
    diffrax = importlib.import_module("diffrax")
    return diffrax.diffeqsolve(
        hhtjax.interop.diffrax_term(scene.system),
        getattr(diffrax, solver)(),
        0.0,
        duration,
        None,
        (scene.q0, scene.v0),
        params,
        stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-9),
        **options,
    )
