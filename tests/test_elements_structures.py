"""Structures of elements at rest, beside published ones and beside the equations of a rod."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from static_structures import equilibrium, rod_tip

from hhtjax import elements, rotation

FRAME = rotation.exp(jnp.array([0.3, -0.5, 0.4]))


def straight(num_elements, length, kind):
    x = jnp.linspace(0.0, length, num_elements + 1)
    if kind == "spatial":
        R = jnp.broadcast_to(jnp.eye(3), (x.size, 3, 3))
        return {"r": jnp.stack([x, 0 * x, 0 * x], axis=1), "R": R}
    r = jnp.stack([x, 0 * x], axis=1)
    return {"r": r, "theta": 0 * x} if kind == "planar" else {"r": r, "slope": jnp.stack([0 * x + 1, 0 * x], axis=1)}


@pytest.mark.parametrize("num_elements", [2, 5])
def test_a_moment_rolls_a_beam_up_into_a_circle(num_elements):
    """Simo, Vu-Quoc (1986), Sec. 5.1: 2 pi EI/L at the end; the angles are exact with any number of elements."""
    each = {"L": 1.0 / num_elements, "EA": 1e4, "GA": 4e3, "EI": 3.0}
    q = equilibrium(elements.planar_beam, each, straight(num_elements, 1.0, "planar"), {"theta": 2 * np.pi * 3.0}, 12)
    np.testing.assert_allclose(q["r"][-1], 0.0, atol=1e-9)
    np.testing.assert_allclose(q["theta"], np.linspace(0, 2 * np.pi, num_elements + 1), atol=1e-9)


SECTION = {"EA": 2.07e9, "EI": 2.07e11 * 0.1**4 / 12}
TIP_FORCE = {"r": np.array([0.0, -3 * SECTION["EI"] / 4])}
ELASTICA = np.array([-0.508537304326, -1.207239854550])  # exudyn, Examples/ANCFcantileverTest.py; -.5085373043260,
# -1.2072398545499 by a boundary value problem of the elastica with EA


def elastica(element, kind, more, num_elements):
    each = SECTION | more | {"L": 2.0 / num_elements}
    q = equilibrium(element, each, straight(num_elements, 2.0, kind), TIP_FORCE)
    return np.asarray(q["r"][-1]) - [2.0, 0.0]


def extrapolated(values, order):
    """One level of Richardson's, for twice as many elements each."""
    return [(2**order * b - a) / (2**order - 1) for a, b in pairwise(values)]


@pytest.mark.slow
def test_planar_beams_converge_to_the_elastica_with_order_2():
    tips = [elastica(elements.planar_beam, "planar", {"GA": 1e15}, n) for n in (8, 16, 32)]
    errors = [np.linalg.norm(tip - ELASTICA) for tip in tips]
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.05
    assert abs(np.log2(errors[1] / errors[2]) - 2) < 0.05
    (twice,) = extrapolated(extrapolated(tips, 2), 4)
    np.testing.assert_allclose(twice, ELASTICA, atol=5e-9)


@pytest.mark.slow
def test_cables_converge_to_the_elastica():
    """With 16 elements to 1e-6, and with 32 to 4e-8."""
    tips = [elastica(elements.ancf_cable, "ancf", {}, n) for n in (16, 32)]
    np.testing.assert_allclose(tips[0], ELASTICA, atol=1e-6)
    np.testing.assert_allclose(tips[1], ELASTICA, atol=4e-8)


def test_a_short_beam_shears_as_published():
    """Nachbagauer et al., Multibody Syst. Dyn. 26 (2011): the tip of a cantilever of 1024 elements."""
    nu, h, w = 0.3, 0.5, 0.1
    each = {
        "EA": 2.07e11 * h * w,
        "EI": 2.07e11 * w * h**3 / 12,
        "GA": 10 * (1 + nu) / (12 + 11 * nu) * 2.07e11 * h * w / 2.6,
    }
    tips = []
    for n in (8, 16):
        q = equilibrium(
            elements.planar_beam, each | {"L": 2.0 / n}, straight(n, 2.0, "planar"), {"r": np.array([0.0, 6.25e7])}
        )
        tips.append(np.asarray(q["r"][-1]))
    (tip,) = extrapolated(tips, 2)
    np.testing.assert_allclose([2.0 - tip[0], tip[1]], [0.15097103, 0.71056837], atol=1e-6)


def princeton_beam():
    """Aluminium 7075, .508 m by 12.3777 mm by 3.2024 mm (Dowell, Traybar 1975); torsion of a rectangle: 3.103 N m^2."""
    h, w, E, nu = 12.3777e-3, 3.2024e-3, 71.7e9, 0.31
    GA = E * h * w / (2 * (1 + nu))
    return {"EA": E * h * w, "GAy": GA, "GAz": GA, "GJ": 3.103, "EIy": E * h * w**3 / 12, "EIz": E * w * h**3 / 12}


@pytest.mark.slow
def test_the_princeton_beam():
    """ANSYS, beams: Obrezkov et al., Nonlinear Dyn. 109 (2022) 31-54; 8.896 N at 45 degrees."""
    each, force = princeton_beam(), 8.896 * np.array([0.0, -1.0, 1.0]) / np.sqrt(2)
    tips = []
    for n in (4, 8):
        q = equilibrium(elements.spatial_beam, each | {"L": 0.508 / n}, straight(n, 0.508, "spatial"), {"r": force}, 4)
        tips.append(np.asarray(q["r"][-1]) - [0.508, 0, 0])
    (tip,) = extrapolated(tips, 2)
    np.testing.assert_allclose([-tip[1], tip[2]], [0.008837226265, 0.108987937], rtol=0.01)
    limit = rod_tip(np.zeros(3), 0.508, list(each.values()), force) - [0.508, 0, 0]
    np.testing.assert_allclose(tip, limit, atol=1e-5)


def bend(num_elements, force, **more):
    """The tip of the bend: an eighth of a circle of radius 100 in the plane of x and y, clamped where it is along x."""
    angles = np.linspace(0, np.pi / 4, num_elements + 1)
    r = jnp.asarray(100 * np.stack([np.sin(angles), 1 - np.cos(angles), 0 * angles], axis=1))
    q = {"r": r, "R": jax.vmap(rotation.exp)(jnp.stack([0 * angles, 0 * angles, angles], axis=1))}
    each = BEND | {"L": 25 * np.pi / num_elements}
    rest = jnp.stack([elements.spatial_strain({name: x[i : i + 2] for name, x in q.items()}, each) for i in (0, 1)])
    np.testing.assert_allclose(rest[0], rest[1], atol=1e-14)
    q = equilibrium(elements.spatial_beam, each | {"rest": rest[0]}, q, {"r": np.array([0.0, 0.0, force])})
    return np.asarray(q["r"][-1])


BEND = {"EA": 1e7, "GAy": 5e6, "GAz": 5e6, "GJ": 7.02885e5, "EIy": 1e7 / 12, "EIz": 1e7 / 12}
PUBLISHED = {300.0: (58.84, 22.33, 40.08), 450.0: (52.32, 18.62, 48.39), 600.0: (47.23, 15.79, 53.37)}


@pytest.mark.slow
def test_the_45_degree_bend():
    """Bathe, Bolourchi (1979); tips for 8 elements by Simo, Vu-Quoc (1986)."""
    for force, tip in PUBLISHED.items():
        found = bend(8, force)
        assert np.linalg.norm(found - tip) < 0.01 * np.linalg.norm(tip)
    limit = rod_tip(np.array([0.0, 0.0, 0.01]), 25 * np.pi, list(BEND.values()), np.array([0.0, 0.0, 600.0]))
    tips = [bend(n, 600.0) for n in (4, 8)]
    errors = [np.linalg.norm(tip - limit) for tip in tips]
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.05
    np.testing.assert_allclose(extrapolated(tips, 2)[0], limit, atol=6e-3)


@pytest.mark.slow
def test_frames_describe_one_beam_in_other_coordinates():
    """Nodes turned by B^T, and B as the frame: the same places."""
    each, force = princeton_beam() | {"L": 0.127}, {"r": np.array([0.0, -3.0, 5.0])}
    q = straight(4, 0.508, "spatial")
    plain = equilibrium(elements.spatial_beam, each, q, force, 4)
    framed = equilibrium(elements.spatial_beam, each | {"frame": FRAME}, q | {"R": q["R"] @ FRAME.T}, force, 4)
    np.testing.assert_allclose(framed["r"], plain["r"], atol=1e-10)
    np.testing.assert_allclose(framed["R"] @ FRAME, plain["R"], atol=1e-10)
