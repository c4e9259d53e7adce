"""Joints between elements: 0 under the motions that they allow, one independent row for each that they do not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from static_structures import moved, rates_like

from hhtjax import elements, rotation

A, B, AXIS = jnp.array([0.3, -0.2, 0.5]), jnp.array([-0.1, 0.4, 0.2]), jnp.array([1.0, -2.0, 0.5])
PLANAR = {"a": A[:2], "b": B[:2]}
SPATIAL = {"a": A, "b": B}
FRAME = rotation.exp(jnp.array([0.3, -0.5, 0.4]))
SECOND = {2: (jnp.array([0.7, 0.1]), 0.8), 3: (jnp.array([0.7, 0.1, -0.4]), rotation.exp(jnp.array([0.2, 1.0, -0.6])))}


def matrix(angle):
    return jnp.stack([jnp.stack([jnp.cos(angle), -jnp.sin(angle)]), jnp.stack([jnp.sin(angle), jnp.cos(angle)])])


def held(joint, each, x, ground):
    """Both bodies, the first where the joint lets it be: x are the coordinates that it leaves free."""
    d = each["b"].size
    r2, turn2 = (jnp.zeros(d), 0.0 if d == 2 else jnp.eye(3)) if ground else SECOND[d]
    frame = each.get("frame", 0.0 if d == 2 else jnp.eye(3))
    axis = each.get("axis")
    along = jnp.zeros(d)
    if d == 2:  # theta_2 - theta_1 = frame
        turn1 = turn2 - frame + (x[-1] if joint in (elements.pin, elements.slider) else 0.0)
        A1, A2 = matrix(turn1), matrix(turn2)
    else:  # R_1^T R_2 = frame
        free = {elements.pin: x[:3], elements.slider: x[-3:], elements.revolute: x[0] * axis if axis is not None else 0}
        A1 = turn1 = turn2 @ rotation.exp(free.get(joint, jnp.zeros(3))) @ frame.T
        A2 = turn2
    if joint in (elements.slider, elements.prismatic):
        along = x[0] * axis
    r1 = r2 + A2 @ (each["b"] + along) - A1 @ each["a"]
    name = "theta" if d == 2 else "R"
    return {"r": jnp.stack([r1, r2][: 1 if ground else 2]), name: jnp.stack([turn1, turn2][: 1 if ground else 2])}


JOINTS = {  # joint, what it holds, rows, motions that it leaves free
    "pin, plane": (elements.pin, PLANAR, 2, 1),
    "weld, plane": (elements.weld, PLANAR | {"frame": jnp.array(0.3)}, 3, 0),
    "slider, plane": (elements.slider, PLANAR | {"axis": AXIS[:2]}, 1, 2),
    "prismatic, plane": (elements.prismatic, PLANAR | {"axis": AXIS[:2], "frame": jnp.array(0.3)}, 2, 1),
    "pin, space": (elements.pin, SPATIAL, 3, 3),
    "weld, space": (elements.weld, SPATIAL | {"frame": FRAME}, 6, 0),
    "revolute": (elements.revolute, SPATIAL | {"axis": AXIS, "frame": FRAME}, 5, 1),
    "slider, space": (elements.slider, SPATIAL | {"axis": AXIS}, 2, 4),
    "prismatic, space": (elements.prismatic, SPATIAL | {"axis": AXIS, "frame": FRAME}, 5, 1),
}
every_joint = pytest.mark.parametrize("case", JOINTS)
on_ground = pytest.mark.parametrize("ground", [False, True], ids=["two bodies", "ground"])


@every_joint
@on_ground
def test_joints_allow_their_motions_and_no_others(case, ground):
    joint, each, rows, free = JOINTS[case]
    x = jnp.array([0.4, -0.3, 0.2, 0.6])[:free]
    q = held(joint, each, x, ground)
    value = jax.jit(lambda q: joint(q, 0.0, {}, each))
    assert value(q).shape == (rows,)
    np.testing.assert_allclose(value(q), 0.0, atol=2e-15)
    d = each["b"].size
    flat, back = ravel_pytree(rates_like(q))
    slopes = jax.jit(jax.jacfwd(lambda x: value(moved(q, back(x)))))(flat)
    assert rows + free == {2: 3, 3: 6}[d]
    assert np.linalg.matrix_rank(slopes, tol=1e-6) == rows
    assert np.linalg.svd(slopes, compute_uv=False)[-1] > 0.1  # rows are far from repeating one another
    h = 1e-6 * jnp.eye(flat.size)
    differences = jax.vmap(lambda x: value(moved(q, back(x))))(jnp.concatenate([h, -h]))
    np.testing.assert_allclose(slopes, (differences[: flat.size] - differences[flat.size :]).T / 2e-6, atol=1e-9)


@every_joint
def test_joints_say_how_far_they_are_off(case):
    """In m and rad: a first body that is displaced, or turned, by a little."""
    joint, each, _, free = JOINTS[case]
    q = held(joint, each, jnp.zeros(free), False)
    small, d = 1e-7, each["b"].size
    name = "theta" if d == 2 else "R"
    shift = (
        jnp.array([1.0, 2.0, -2.0])[:d] / jnp.array([1.0, 2.0, -2.0])[:d].dot(jnp.array([1.0, 2.0, -2.0])[:d]) ** 0.5
    )
    x = rates_like(q)
    off = joint(moved(q, x | {"r": x["r"].at[0].set(small * shift)}), 0.0, {}, each) / small
    A2 = matrix(q["theta"][1]) if d == 2 else q["R"][1]
    inside = A2.T @ shift
    if "axis" in each and joint is not elements.revolute:
        inside = inside - each["axis"] * jnp.sum(each["axis"] * inside) / jnp.sum(each["axis"] ** 2)
    np.testing.assert_allclose(jnp.linalg.norm(off), jnp.linalg.norm(inside), atol=1e-6)
    if joint in (elements.weld, elements.prismatic):
        turn = jnp.array(1.0) if d == 2 else shift
        q = held(joint, each | {"a": 0 * each["a"]}, jnp.zeros(free), False)  # about the point itself
        off = joint(moved(q, x | {name: x[name].at[0].set(small * turn)}), 0.0, {}, each | {"a": 0 * each["a"]}) / small
        np.testing.assert_allclose(jnp.linalg.norm(off), 1.0, atol=1e-6)


@pytest.mark.parametrize("axis", [[0, 0, 1.0], [0, 0, -1.0], [1.0, 0, 0], [0.3, -2, -1e-9], [3.0, 1.0, -2.0]])
def test_directions_across_an_axis(axis):
    """Also where it is that of the formula's pole."""
    from hhtjax.elements.joints import across

    n = np.asarray(across(jnp.array(axis)))
    np.testing.assert_allclose(n @ n.T, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(n @ axis, 0.0, atol=1e-15)


def test_a_rigid_link_keeps_a_distance():
    """Of points that go round one another, of bodies and of places; 1 row, its slope the direction."""
    turn = rotation.exp(jnp.array([0.4, 0.2, -1.0]))
    q = {"r": jnp.stack([jnp.zeros(3), turn @ jnp.array([0.0, 0.0, 2.5])])}
    np.testing.assert_allclose(elements.rigid_link(q, 0.0, {}, {"L": 2.5}), 0.0, atol=1e-15)
    slope = jax.jacfwd(lambda r: elements.rigid_link({"r": r}, 0.0, {}, {"L": 2.5}))(q["r"])
    np.testing.assert_allclose(slope[0, 1], turn[:, 2], atol=1e-15)
    body = held(elements.pin, SPATIAL, jnp.array([0.4, -0.3, 0.2]), False)
    apart = body | {"r": body["r"].at[0].add(jnp.array([0.0, 3.0, 4.0]))}
    np.testing.assert_allclose(elements.rigid_link(apart, 0.0, {}, SPATIAL | {"L": 5.0}), 0.0, atol=1e-14)


def test_places_without_directions_are_held_too():
    """Nodes with r alone: held together, to a place of the ground, and on a line of it."""
    q = {"r": jnp.array([[1.0, 2.0], [1.5, 2.0]])}
    np.testing.assert_allclose(elements.pin(q, 0.0, {}), [-0.5, 0.0])
    first = {"r": q["r"][:1]}
    np.testing.assert_allclose(elements.pin(first, 0.0, {}, {"b": jnp.array([1.0, 1.5])}), [0.0, 0.5])
    line = {"b": jnp.array([5.0, 3.0]), "axis": jnp.array([2.0, 0.0])}
    np.testing.assert_allclose(elements.slider(first, 0.0, {}, line), [-1.0])


def test_a_slider_crank_is_held():
    """Crank .15 m at 40 degrees, rod .3 m, a piston on the line y = 0: 8 rows for 9 coordinates, all of them 0."""
    phi = np.deg2rad(40.0)
    psi = -np.arcsin(0.15 * np.sin(phi) / 0.3)
    knee = 0.15 * np.array([np.cos(phi), np.sin(phi)])
    end = knee + 0.3 * np.array([np.cos(psi), np.sin(psi)])
    r, theta = jnp.asarray([knee / 2, (knee + end) / 2, end]), jnp.array([phi, psi, 0.0])
    half = jnp.array([0.075, 0.0]), jnp.array([0.15, 0.0])

    def rows(q):
        of = lambda *nodes: {name: x[jnp.array(nodes)] for name, x in q.items()}  # noqa: E731
        return jnp.concatenate([
            elements.pin(of(0), 0.0, {}, {"a": -half[0]}),
            elements.pin(of(0, 1), 0.0, {}, {"a": half[0], "b": -half[1]}),
            elements.pin(of(1, 2), 0.0, {}, {"a": half[1]}),
            elements.prismatic(of(2), 0.0, {}, {"axis": jnp.array([1.0, 0.0])}),
        ])  # fmt: skip

    q = {"r": r, "theta": theta}
    np.testing.assert_allclose(rows(q), 0.0, atol=1e-15)
    slopes = jax.jit(jax.jacfwd(rows))(q)
    B = jnp.concatenate([slopes["r"].reshape(8, 6), slopes["theta"]], axis=1)
    assert np.linalg.matrix_rank(B, tol=1e-6) == 8
    free = np.linalg.svd(B)[2][-1]  # the motion that is left
    rate = -0.15 * np.cos(phi) / (0.3 * np.cos(psi))  # dpsi/dphi
    np.testing.assert_allclose(free[7] / free[6], rate, rtol=1e-12)
    piston = -0.15 * np.sin(phi) - 0.3 * np.sin(psi) * rate
    np.testing.assert_allclose(free[4] / free[6], piston, rtol=1e-12)


def test_a_pinned_beam_is_a_body_with_offsets():
    """Two beams pinned end to end share a place and not an angle."""
    q = {"r": jnp.array([[1.0, 0.0], [1.0, 0.0]]), "theta": jnp.array([0.2, -0.7])}
    np.testing.assert_allclose(elements.pin(q, 0.0, {}, {}), 0.0)
    assert float(elements.weld(q, 0.0, {}, None)[2]) == pytest.approx(-0.9)
    assert float(elements.weld(q, 0.0, {}, {"frame": -0.9})[2]) == pytest.approx(0.0)


@pytest.mark.parametrize("case", JOINTS)
def test_float32_stays(case):
    joint, each, _, free = JOINTS[case]
    q = held(joint, each, jnp.zeros(free), False)
    q, each = (jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), x) for x in (q, each))
    found = joint(q, jnp.float32(0.0), {}, each)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("joint", "q", "each", "message"),
    [
        (elements.pin, {"r": jnp.zeros((3, 2))}, {}, r"pin: `q` must hold 'r' of one or two nodes"),
        (elements.pin, {"r": jnp.zeros((2, 2)), "theta": jnp.zeros(2)}, {"a": jnp.zeros(3)}, r"must have shape \(2,\)"),
        (elements.pin, {"r": jnp.zeros((2, 2)), "theta": jnp.zeros(2)}, {"c": jnp.zeros(2), "x": 1.0}, r"\['x'\]"),
        (elements.weld, {"r": jnp.zeros((2, 2))}, {}, r"weld: `q` must be a dict with the leaves \['theta'\]"),
        (elements.revolute, {"r": jnp.zeros((2, 2)), "theta": jnp.zeros(2)}, {"axis": jnp.ones(2)}, "'R'"),
        (elements.rigid_link, {"r": jnp.zeros((2, 2))}, {}, r"rigid_link: `each` must be a dict with \['L'\]"),
    ],
)
def test_bad_arguments_are_told(joint, q, each, message):
    with pytest.raises(ValueError, match=message):
        joint(q, 0.0, {}, each)
