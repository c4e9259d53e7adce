"""Elements one by one: forces are exact gradients, and rigid motions turn them."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from static_structures import chain, force_of, moved, rates_like

from hhtjax import elements, rotation

PLANAR = {"L": 0.7, "EA": 90.0, "GA": 40.0, "EI": 3.0}
SPATIAL = {"L": 0.7, "EA": 90.0, "GAy": 40.0, "GAz": 50.0, "GJ": 2.0, "EIy": 3.0, "EIz": 4.0}
CABLE = {"L": 0.7, "EA": 90.0, "EI": 3.0}
FRAME = rotation.exp(jnp.array([0.3, -0.5, 0.4]))
REST = jnp.array([0.01, -0.02, 0.03, 0.2, -0.3, 0.4])


def turns(*psi):
    return jnp.stack([rotation.exp(jnp.array(x)) for x in psi])


BENT = {  # two nodes of each kind, deformed
    "planar": {"r": jnp.array([[0.1, -0.2], [0.7, 0.3]]), "theta": jnp.array([0.4, 1.3])},
    "spatial": {
        "r": jnp.array([[0.1, -0.2, 0.3], [0.7, 0.3, 0.1]]),
        "R": turns([0.4, 1.0, -0.3], [0.2, -0.4, 0.5]),
    },
    "ancf": {
        "r": jnp.array([[0.1, -0.2, 0.3], [0.7, 0.3, 0.1]]),
        "slope": jnp.array([[1.1, 0.2, 0.3], [0.8, -0.1, 0.4]]),
    },
}
STRAIGHT = {
    "planar": {"r": jnp.array([[0.0, 0.0], [0.7, 0.0]]), "theta": jnp.zeros(2)},
    "spatial": {"r": jnp.array([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]]), "R": turns([0.0] * 3, [0.0] * 3)},
    "ancf": {"r": jnp.array([[0.0, 0.0, 0.0], [0.7, 0.0, 0.0]]), "slope": jnp.array([[1.0, 0.0, 0.0]] * 2)},
}


def planar_energy(q, each):
    """By its own formula, not by planar_strain."""
    angle = jnp.mean(q["theta"]) + each.get("frame", 0.0)
    A = jnp.stack([jnp.stack([jnp.cos(angle), -jnp.sin(angle)]), jnp.stack([jnp.sin(angle), jnp.cos(angle)])])
    strain = jnp.concatenate([A.T @ (q["r"][1] - q["r"][0]), jnp.diff(q["theta"])]) / each["L"] - jnp.array([1.0, 0, 0])
    C = jnp.array([each["EA"], each["GA"], each["EI"]])
    return each["L"] / 2 * jnp.sum(C * (strain - each.get("rest", jnp.zeros(3))) ** 2)


def spatial_energy(q, each):
    """By its own formula, not by spatial_strain."""
    B = each.get("frame", jnp.eye(3))
    R1, R2 = q["R"][0] @ B, q["R"][1] @ B
    psi = rotation.log(R1.T @ R2)
    Gamma = rotation.exp(psi / 2).T @ R1.T @ (q["r"][1] - q["r"][0]) / each["L"] - jnp.eye(3)[0]
    strain = jnp.concatenate([Gamma, psi / each["L"]]) - each.get("rest", jnp.zeros(6))
    C = jnp.array([each[name] for name in ("EA", "GAy", "GAz", "GJ", "EIy", "EIz")])
    return each["L"] / 2 * jnp.sum(C * strain**2)


def cable_energy(q, each):
    """By cross products and powers of s."""
    L = each["L"]
    (r1, r2), (t1, t2) = q["r"], q["slope"]
    a3, a2, a1 = 2 * (r1 - r2) + L * (t1 + t2), 3 * (r2 - r1) - L * (2 * t1 + t2), L * t1

    def total(points, density):
        s, w = np.polynomial.legendre.leggauss(points)
        return L * sum(
            wi / 2 * density((3 * a3 * si**2 + 2 * a2 * si + a1) / L, (6 * a3 * si + 2 * a2) / L**2)
            for si, wi in zip((s + 1) / 2, w, strict=True)
        )

    stretching = total(3, lambda a, b: each["EA"] / 2 * (jnp.linalg.norm(a) - 1) ** 2)
    return stretching + total(3, lambda a, b: each["EI"] / 2 * jnp.sum(rotation.cross(a, b) ** 2) / jnp.sum(a**2) ** 2)


def bar_energy(q, each):
    return each["EA"] / (2 * each["L"]) * (jnp.linalg.norm(q["r"][1] - q["r"][0]) - each["L"]) ** 2


def spring_energy(q, each):
    return each["k"] / 2 * (jnp.linalg.norm(q["r"][1] - q["r"][0]) - each["L"]) ** 2


def torsion_energy(q, each):
    if "R" in q:
        return each["k"] / 2 * jnp.sum(rotation.log(q["R"][0].T @ q["R"][1]) ** 2)
    return each["k"] / 2 * (q["theta"][1] - q["theta"][0] - each["angle"]) ** 2


SPRING, TORSION = {"L": 0.5, "k": 7.0}, {"k": 7.0}
CASES = {  # element, what it holds, its energy, its nodes
    "planar_beam": (elements.planar_beam, PLANAR, planar_energy, "planar"),
    "planar_beam, more": (
        elements.planar_beam, PLANAR | {"frame": 0.3, "rest": jnp.array([0.01, -0.02, 0.2])}, planar_energy, "planar",
    ),
    "spatial_beam": (elements.spatial_beam, SPATIAL, spatial_energy, "spatial"),
    "spatial_beam, more": (elements.spatial_beam, SPATIAL | {"frame": FRAME, "rest": REST}, spatial_energy, "spatial"),
    "ancf_cable": (elements.ancf_cable, CABLE, cable_energy, "ancf"),
    "truss": (elements.truss, {"L": 0.5, "EA": 7.0}, bar_energy, "ancf"),
    "spring_damper": (elements.spring_damper, SPRING, spring_energy, "planar"),
    "torsion_spring, plane": (elements.torsion_spring, TORSION | {"angle": 0.2}, torsion_energy, "planar"),
    "torsion_spring, space": (elements.torsion_spring, TORSION, torsion_energy, "spatial"),
}  # fmt: skip
every_element = pytest.mark.parametrize("case", CASES)


def whole(force, q):
    """With zeros in the place of the leaves that are left out."""
    return {name: force.get(name, x) for name, x in rates_like(q).items()}


def closeness(x, y):
    return max(float(jnp.max(jnp.abs(x[name] - y[name]))) for name in y)


@cache
def compiled(element):
    return jax.jit(element)


def force(case, q, v=None):
    element, each, _, _ = CASES[case]
    return whole(compiled(element)(q, rates_like(q) if v is None else v, 0.0, {}, each), q)


@every_element
def test_the_force_is_the_gradient_of_the_energy(case):
    _, each, energy, kind = CASES[case]
    q = BENT[kind]
    slope = jax.jit(jax.grad(lambda x: energy(moved(q, x), each)))(rates_like(q))
    found = force(case, q)
    assert max(float(jnp.max(jnp.abs(x))) for x in found.values()) > 0.1
    assert closeness(found, {name: -x for name, x in slope.items()}) < 1e-12


def turned(q, Q, shift):
    """After a rigid motion."""
    moves = {"r": lambda x: x @ Q.T + shift, "slope": lambda x: x @ Q.T, "R": lambda x: Q @ x}
    moves["theta"] = lambda x: x + np.arctan2(Q[1, 0], Q[0, 0])
    return {name: jnp.asarray(moves[name](np.asarray(x))) for name, x in q.items()}


def rigid_motion(kind):
    if kind == "planar":
        return np.array([[np.cos(2.0), -np.sin(2.0)], [np.sin(2.0), np.cos(2.0)]]), np.array([3.0, -2.0])
    return np.asarray(rotation.exp(jnp.array([1.0, -2.0, 0.5]))), np.array([3.0, -2.0, 1.0])


@every_element
def test_a_rigid_motion_turns_the_force(case):
    _, each, energy, kind = CASES[case]
    Q, shift = rigid_motion(kind)
    q = BENT[kind]
    there, here = turned(q, Q, shift), force(case, q)
    expected = {
        name: x @ jnp.asarray(Q.T) if name in ("r", "slope") else x for name, x in here.items()
    }  # moments: material ones
    assert closeness(force(case, there), expected) < 2e-13
    assert abs(energy(there, each) - energy(q, each)) < 1e-13


@every_element
def test_the_force_has_no_resultant(case):
    """Neither a force nor a moment: a rigid motion does no work."""
    kind = CASES[case][3]
    q = BENT[kind]
    found = force(case, q)
    assert jnp.max(jnp.abs(jnp.sum(found["r"], axis=0))) < 1e-13
    moment = jnp.sum(jnp.cross(q["r"], found["r"]), axis=0)
    if kind == "planar":
        moment = moment + jnp.sum(found["theta"])
    elif kind == "spatial":
        moment = moment + jnp.sum(jnp.einsum("nij,nj->ni", q["R"], found["R"]), axis=0)
    else:
        moment = moment + jnp.sum(jnp.cross(q["slope"], found["slope"]), axis=0)
    assert jnp.max(jnp.abs(moment)) < 1e-13


@cache
def slopes(case):
    """q -> the slopes of the force along displacements, forward and in reverse, by differences, and second ones."""
    element, each, _, _ = CASES[case]

    def all_of_them(q):
        zero = rates_like(q)
        flat, back = ravel_pytree(zero)

        def of_x(x):
            return ravel_pytree(whole(element(moved(q, back(x)), zero, 0.0, {}, each), q))[0]

        h = 1e-5 * jnp.eye(flat.size)
        values = jax.vmap(of_x)(jnp.concatenate([h, -h]))
        second = jax.jvp(lambda x: jax.jvp(of_x, (x,), (flat + 1,))[1], (flat,), (flat + 1,))[1]
        differences = (values[: flat.size] - values[flat.size :]).T / 2e-5
        return jax.jacfwd(of_x)(flat), jax.jacrev(of_x)(flat), differences, second

    return jax.jit(all_of_them)


@pytest.mark.parametrize("case", [case for case in CASES if "more" not in case])
def test_slopes_are_right_in_both_directions_also_where_nothing_is_deformed(case):
    kind = CASES[case][3]
    for q in (BENT[kind], STRAIGHT[kind]):
        forward, reverse, differences, second = slopes(case)(q)
        size = float(jnp.max(jnp.abs(forward)))
        assert size > 1
        np.testing.assert_allclose(forward, reverse, atol=1e-13 * size)
        np.testing.assert_allclose(forward, differences, atol=1e-8 * size)
        assert np.all(np.isfinite(second))


def test_springs_of_length_zero_have_numbers_for_slopes():
    q = {"r": jnp.zeros((2, 3))}
    for element, each in (
        (elements.truss, {"L": 1.0, "EA": 7.0}),
        (elements.spring_damper, {"L": 0.0, "k": 7.0, "c": 1.0}),
    ):
        slopes = jax.jacfwd(lambda q: element(q, q, 0.0, {}, each)["r"])(q)["r"]  # noqa: B023
        assert np.all(np.isfinite(slopes))


@pytest.mark.parametrize("kind", ["planar", "spatial"])
def test_damping_takes_energy_from_strains_only(kind):
    """Its power is -L sum C damping rate^2, and a rigid motion feels none."""
    element, each, names, strain = (
        (elements.planar_beam, PLANAR, ("EA", "GA", "EI"), elements.planar_strain)
        if kind == "planar"
        else (elements.spatial_beam, SPATIAL, ("EA", "GAy", "GAz", "GJ", "EIy", "EIz"), elements.spatial_strain)
    )
    q = BENT[kind]
    keys = iter(jax.random.split(jax.random.key(0), 4))
    v = {name: jax.random.normal(next(keys), x.shape) for name, x in rates_like(q).items()}

    def damping_force(v):
        f, g = (compiled(element)(q, v, 0.0, {}, x) for x in (each | {"damping": jnp.array(0.1)}, each))
        return {name: f[name] - g[name] for name in f}

    found = damping_force(v)
    power = sum(float(jnp.sum(found[name] * v[name])) for name in v)
    rate = jax.jvp(lambda s: strain(moved(q, {name: s * x for name, x in v.items()}), each), (0.0,), (1.0,))[1]
    expected = -0.1 * each["L"] * sum(each[name] * float(x) ** 2 for name, x in zip(names, rate, strict=True))
    assert abs(power / expected - 1) < 1e-12
    assert closeness(damping_force(rigid_rates(q)), {name: 0 * x for name, x in found.items()}) < 1e-12


def log_rate(q, v):
    """Of the rotation vector between two nodes, or of their angle."""
    if "theta" in q:
        return jnp.diff(v["theta"])
    there = lambda s: moved(q, {name: s * x for name, x in v.items()})["R"]  # noqa: E731
    turn = lambda s: there(0.0)[1].T @ there(0.0)[0] @ there(s)[0].T @ there(s)[1]  # noqa: E731
    return jax.jvp(lambda s: rotation.log(turn(s)), (0.0,), (1.0,))[1]  # angular velocity of 2 beside 1


def length_rate(q, v):
    return jax.jvp(lambda s: jnp.linalg.norm(jnp.diff(q["r"] + s * v["r"], axis=0)), (0.0,), (1.0,))[1]


@pytest.mark.parametrize(
    ("element", "each", "kind", "rate"),
    [
        (elements.spring_damper, SPRING, "planar", length_rate),
        (elements.torsion_spring, TORSION, "planar", log_rate),
        (elements.torsion_spring, TORSION, "spatial", log_rate),
    ],
)
def test_dampers_take_c_times_the_square_of_a_rate(element, each, kind, rate):
    q = BENT[kind]
    keys = iter(jax.random.split(jax.random.key(1), 4))
    v = {name: jax.random.normal(next(keys), x.shape) for name, x in rates_like(q).items()}

    def damping_force(v):
        f, g = (element(q, v, 0.0, {}, x) for x in (each | {"c": 0.3}, each))
        return {name: f[name] - g[name] for name in f}

    power = sum(float(jnp.sum(x * v[name])) for name, x in damping_force(v).items())
    assert abs(power / (-0.3 * float(jnp.sum(rate(q, v) ** 2))) - 1) < 1e-12
    assert all(np.max(np.abs(x)) < 1e-14 for x in damping_force(rigid_rates(q)).values())


def rigid_rates(q):
    """v of a rigid motion."""
    q = {name: np.asarray(x) for name, x in q.items()}
    if "theta" in q:
        v = {
            "r": np.array([1.0, 2.0]) + 3.0 * np.stack([-q["r"][:, 1], q["r"][:, 0]], axis=1),
            "theta": np.full(2, 3.0),
        }
    else:
        omega = np.array([0.5, -2.0, 1.0])
        v = {"r": np.array([1.0, 2.0, 3.0]) + np.cross(omega, q["r"])}
        v |= {"slope": np.cross(omega, q["slope"])} if "slope" in q else {"R": omega @ q["R"]}
    return {name: jnp.asarray(x) for name, x in v.items()}


# ---------------------------------------------------------------------------- masses


MASSES = {  # element, what it holds, nodes of a straight rod, its mass
    "planar": (elements.planar_mass, {"L": 0.7, "rhoA": 3.0, "rhoI": 0.2}),
    "spatial": (elements.spatial_mass, {"L": 0.7, "rhoA": 3.0, "rhoIy": 0.2, "rhoIz": 0.3}),
    "ancf": (elements.ancf_mass, {"L": 0.7, "rhoA": 3.0}),
}


def somewhere(kind):
    Q, shift = rigid_motion(kind)
    return turned(STRAIGHT[kind], Q, shift)


@pytest.mark.parametrize("kind", MASSES)
def test_masses_have_the_kinetic_energy_of_rigid_motions(kind):
    element, each = MASSES[kind]
    q = somewhere(kind)
    v = rigid_rates(q)
    Mv = element(q, v, {}, each)
    energy = sum(float(jnp.sum(v[name] * Mv[name])) for name in v) / 2
    v = {name: np.asarray(x) for name, x in v.items()}
    L, m = each["L"], 3.0 * each["L"]
    middle, ends = np.mean(v["r"], axis=0), np.diff(v["r"], axis=0)[0]
    expected = m / 2 * np.sum(middle**2) + m / 24 * np.sum(ends**2)  # a rod: m/2 v^2 + m L^2/24 |omega x e|^2
    if kind == "planar":
        expected += 0.2 * L / 2 * 9.0
    if kind == "spatial":
        expected += L / 2 * np.sum(np.array([0.5, 0.2, 0.3]) * v["R"][0] ** 2)
    assert abs(energy - expected) < 1e-12 * energy


@pytest.mark.parametrize("kind", MASSES)
def test_masses_are_symmetric_positive_and_whole(kind):
    element, each = MASSES[kind]
    q = BENT[kind]
    each = each | {"frame": FRAME} if kind == "spatial" else each
    flat, back = ravel_pytree(rates_like(q))
    M = jax.jacfwd(lambda w: ravel_pytree(element(q, back(w), {}, each))[0])(flat)
    np.testing.assert_allclose(M, M.T, atol=1e-15)
    assert np.linalg.eigvalsh(M)[0] > 0
    shift = ravel_pytree({name: jnp.ones_like(x) if name == "r" else x for name, x in back(flat).items()})[0]
    assert abs(shift @ M @ shift - 3.0 * 0.7 * q["r"].shape[1]) < 1e-13


def test_the_frame_of_a_beam_turns_its_moments_of_inertia():
    """A beam whose frame is FRAME, and one whose nodes are turned by it, are one body."""
    element, each = MASSES["spatial"]
    q, w = BENT["spatial"], rigid_rates(BENT["spatial"])
    within = element(q, {"r": w["r"], "R": w["R"] @ FRAME}, {}, each)["R"] @ FRAME.T
    np.testing.assert_allclose(element(q, w, {}, each | {"frame": FRAME})["R"], within, atol=1e-15)


def test_lumped_masses_are_whole():
    pairs = chain(3)
    each = {"L": jnp.array([0.5, 1.0, 2.0]), "rhoA": 3.0, "rhoI": 0.2}
    flat = elements.planar_lumped_mass(pairs, each, 5)
    np.testing.assert_allclose(flat["r"][:, 1], [0.75, 2.25, 4.5, 3.0, 0.0])
    np.testing.assert_allclose(jnp.sum(flat["theta"]), 0.2 * 3.5)
    solid = elements.spatial_lumped_mass(pairs, {"L": each["L"], "rhoA": 3.0, "rhoIy": 0.2, "rhoIz": 0.3}, 4)
    np.testing.assert_allclose(jnp.sum(solid["R"], axis=0), 3.5 * np.array([0.5, 0.2, 0.3]))


def test_the_weight_of_an_element_is_that_of_its_shape():
    """On slopes, too: the work of gravity on any cubic is m g times the displacement in the mean."""
    g = jnp.array([0.5, -9.0, 1.0])
    q = BENT["ancf"]
    found = elements.gravity(q, {}, 0.0, {"gravity": g}, {"m": 2.0, "L": 0.7})
    Mg = elements.ancf_mass(q, {"r": jnp.stack([g, g]), "slope": jnp.zeros((2, 3))}, {}, {"L": 0.7, "rhoA": 2.0 / 0.7})
    assert closeness(found, Mg) < 1e-14


def test_a_free_body_keeps_its_angular_momentum():
    """J Omdot = -Om x J Om: R J Om is constant."""
    J = jnp.array([[2.0, 0.3, 0.1], [0.3, 3.0, 0.2], [0.1, 0.2, 4.0]])
    Om = jnp.array([1.0, -2.0, 0.5])
    moment = elements.gyroscopic({"R": FRAME[None]}, {"R": Om[None]}, 0.0, {}, {"J": J})["R"][0]
    rate = FRAME @ (rotation.hat(Om) @ J @ Om + moment)  # of R J Om
    np.testing.assert_allclose(rate, 0.0, atol=1e-14)


# ---------------------------------------------------------------------------- arguments


@every_element
def test_float32_stays(case):
    element, each, _, kind = CASES[case]
    q, each = (jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), x) for x in (BENT[kind], each))
    found = compiled(element)(q, rates_like(q), jnp.float32(0.0), {}, each)
    assert {x.dtype for x in found.values()} == {jnp.dtype(jnp.float32)}
    for name, x in found.items():
        np.testing.assert_allclose(x, force(case, BENT[kind])[name], atol=1e-4)


def test_many_at_once_are_traced_once():
    q = jax.tree.map(lambda x: jnp.stack([x, x]), BENT["spatial"])
    count = []

    @jax.jit
    def total(q, each):
        count.append(1)
        pairs = np.array([[0, 1], [1, 2]])
        return force_of(elements.spatial_beam, pairs, each, q, rates_like(q))

    each = {name: jnp.full(2, x) for name, x in SPATIAL.items()}
    flat = {name: jnp.concatenate([x[0], x[1, :1]]) for name, x in q.items()}
    assert all(np.all(np.isfinite(x)) for _ in range(2) for x in total(flat, each).values())
    assert len(count) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda q: elements.planar_beam({"r": q["r"]}, q, 0.0, {}, PLANAR),
            r"planar_beam: `q` .* \['r', 'theta'\]; received",
        ),
        (lambda q: elements.planar_beam(q, q, 0.0, {}, {"L": 1.0}), r"planar_beam: `each` must be a dict with .*'EI'"),
        (lambda q: elements.planar_beam(q, q, 0.0, {}, PLANAR | {"dampng": 0.1}), r"received \['dampng'\]"),
        (
            lambda q: elements.planar_beam(q, q, 0.0, {}, PLANAR | {"L": jnp.ones(2)}),
            r"each\['L'\]` must have shape \(\)",
        ),
        (
            lambda q: elements.planar_strain({"r": jnp.zeros((3, 2)), "theta": jnp.zeros(3)}, PLANAR),
            r"in shape \(2, 2\)",
        ),
        (lambda q: elements.spatial_beam(q, q, 0.0, {}, SPATIAL), r"spatial_beam: `q` .* \['R', 'r'\]"),
        (lambda q: elements.ancf_cable(q, q, 0.0, {}, CABLE), r"ancf_cable: `q` .* \['r', 'slope'\]"),
        (lambda q: elements.truss({}, {}, 0.0, {}, {"L": 1.0, "EA": 1.0}), r"truss: `q` .* \['r'\]; received \[\]"),
        (lambda q: elements.gyroscopic(q, q, 0.0, {}, {"J": jnp.ones(3)}), r"gyroscopic: `q` .* \['R'\]"),
        (lambda q: elements.gravity({}, q, 0.0, {}, {"m": 1.0}), r"gravity: `q` .* \['r'\]"),
        (lambda q: elements.gravity(q, q, 0.0, {}, {"m": 1.0}), r"`params` must hold 'gravity' in shape \(2,\)"),
        (lambda q: elements.spatial_lumped_mass(chain(1), MASSES["spatial"][1] | {"frame": FRAME}, 2), "no 'frame'"),
        (lambda q: elements.pin({"r": q["r"]}, 0.0, {}, {"a": jnp.ones(2)}), "no 'a' for nodes that do not turn"),
        (lambda q: elements.slider(q, 0.0, {}, {}), r"slider: `each` must be a dict with \['axis'\]"),
    ],
)
def test_bad_arguments_are_told(call, message):
    with pytest.raises(ValueError, match=message):
        call(BENT["planar"])


def test_numbers_must_be_real():
    with pytest.raises(TypeError, match=r"planar_beam: `each\['EA'\]` must be real; received 'soft'"):
        elements.planar_beam(BENT["planar"], rates_like(BENT["planar"]), 0.0, {}, PLANAR | {"EA": "soft"})
