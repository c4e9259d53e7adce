"""Systems of elements and joints: what they add up to, what holds them, and their steps beside dense ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from element_scenes import (
    PARAMS,
    bar,
    bodies,
    by_lapack,
    chain,
    distance,
    driven,
    hub,
    lattice,
    line,
    links,
    motion,
    net,
    parts,
    pin,
    ring,
    rod,
    run,
    shaken,
    spring,
    spun,
    weight,
)

import hhtjax
from hhtjax import Elements, Joints, System
from hhtjax.numerics.dense_lu import full_matrix
from hhtjax.numerics.sparse_matrix import Sparse
from hhtjax.systems.flat_system import flatten

NEWTON = {"iterations": None, "start": "simple"}
INDEX_3 = {"formulation": "index3", "start": "simple"}
SCENES = {
    "ring": ring,
    "parts": parts,
    "hub": hub,
    "driven": driven,
    "consistent": lambda: driven(mass=[0.1, Elements(bar, line(9))]),
    "links": links,
    "lattice": lattice,
    "bodies": bodies,
}
SIMPLE = {name: {"start": "simple", "linearize": "predictor"} for name in ("ring", "hub", "lattice", "bodies")}


@pytest.fixture(scope="module")
def runs():
    """Sparse ones, by name; made when they are first asked for."""
    made = {}

    def find(name):
        if name not in made:
            made[name] = run(SCENES[name](), **SIMPLE.get(name, {}))
        return made[name]

    return find


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_steps_are_those_of_the_dense_solve(name, runs):
    sparse, dense = runs(name), run(SCENES[name](), solve=by_lapack, **SIMPLE.get(name, {}))
    sparse.check()
    size = max(1.0, float(jnp.max(jnp.abs(jax.tree.leaves(dense.acceleration)[0]))))
    assert distance(motion(sparse)[:2], motion(dense)[:2]) < 1e-13
    assert distance(motion(sparse)[2:], motion(dense)[2:]) < 1e-12 * size
    assert np.max(sparse.info.solve_residual) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(("make", "options"), [(driven, NEWTON), (links, INDEX_3)], ids=["newton", "index3"])
def test_other_kinds_of_steps(make, options):
    sparse, dense = (run(make(), solve=solve, **options) for solve in (None, by_lapack))
    assert distance(motion(sparse)[:2], motion(dense)[:2]) < 1e-11
    assert distance(motion(sparse)[2:], motion(dense)[2:]) < 1e-8


@pytest.mark.slow
def test_plain_jax_gives_the_same_numbers(runs):
    with hhtjax.plain():
        found = run(driven())
    assert distance(motion(found), motion(runs("driven"))) < 1e-12


@pytest.mark.slow
def test_single_precision_stays_single(runs):
    single = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)  # noqa: E731
    system, q0, v0 = links()
    with pytest.warns(hhtjax.PrecisionWarning):
        found = run((system, single(q0), single(v0)), single(PARAMS))
    found.check()
    assert {x.dtype for x in jax.tree.leaves(motion(found))} == {np.dtype(np.float32)}
    assert distance(found.q, runs("links").q) < 1e-4


# ----------------------------------------------------------------------------
# What elements add up to.


def by_hand(pairs, q, v):
    """The force of springs and weights, one after the other."""
    Q = np.zeros_like(q)
    Q[:, 1] -= PARAMS["g"]
    for a, b in pairs:
        pull = np.asarray(spring(jnp.asarray(q[[a, b]]), jnp.asarray(v[[a, b]]), 0.0, PARAMS))
        Q[a] += pull[0]
        Q[b] += pull[1]
    return Q


@pytest.mark.parametrize("make", [chain, ring, hub, parts])
def test_forces_add_up_at_the_nodes(make):
    system, q, _ = make(**({"held": None} if make is chain else {}))
    v = np.random.default_rng(0).normal(size=q.shape)
    pairs = system.force.elements.first.nodes.tree
    found = jax.jit(system.force)(q, v, 0.0, PARAMS)
    np.testing.assert_allclose(found, by_hand(pairs, np.asarray(q), v), rtol=1e-12, atol=1e-12)


def scaled(q, v, t, params, each):
    pull = each["k"] * (q[1] - q[0])
    return jnp.stack([pull, -pull])


def test_each_element_gets_its_own_numbers():
    q, k = jnp.arange(6.0) ** 2, np.arange(1.0, 6)
    given = Elements(scaled, line(6), each={"k": k})
    fitted = Elements(scaled, line(6), each=lambda params: {"k": params["k"]})
    shared = Elements(scaled, line(6), each={"k": 2.0})
    pull = np.append(k * np.diff(q), 0) - np.append(0, k * np.diff(q))
    np.testing.assert_allclose(given(q, q, 0.0, None), pull)
    np.testing.assert_allclose(fitted(q, q, 0.0, {"k": jnp.asarray(k)}), pull)
    both = np.append(2 * np.diff(q), 0) - np.append(0, 2 * np.diff(q))
    np.testing.assert_allclose(shared(q, q, 0.0, None), both)
    slope = jax.jacfwd(lambda k: fitted(q, q, 0.0, {"k": k}))(jnp.asarray(k))
    np.testing.assert_allclose(slope @ k, pull)
    assert given == Elements(scaled, line(6), each={"k": k.copy()})  # equal systems, equal programs
    assert given != Elements(scaled, line(6), each={"k": 2 * k})


def across(q, v, t, params):
    """From a point to a plate; of the plate's other leaf it tells nothing."""
    pull = params["k"] * (q["plate"][0] - q["point"][0])
    return {"point": pull[None], "plate": -pull[None]}


def test_sets_of_nodes_of_several_kinds():
    part = Elements(across, {"point": [[0], [2]], "plate": [[0], [0]]})
    q = {"plate": jnp.ones((1, 2)), "point": jnp.arange(6.0).reshape(3, 2), "spare": jnp.zeros((4, 3))}
    found = part(q, q, 0.0, {"k": 2.0})
    np.testing.assert_allclose(found["point"], [[2, 0], [0, 0], [-6, -8]])
    np.testing.assert_allclose(found["plate"], [[4, 8]])
    assert not np.any(found["spare"])
    held = {2: {"point": True}}  # the plate has no such node
    system = System.from_elements(part, mass={"plate": 1.0, "point": 1.0, "spare": 1.0}, held=held)
    assert not np.any(system.force(q, q, 0.0, {"k": 2.0})["point"][2])


MASSES = {
    "number": 2.0,
    "of each number": np.arange(1.0, 7),
    "of each node": np.array([1.0, 2.0, 3.0]),
    "leaf": np.arange(1.0, 7).reshape(3, 2),
    "function": lambda params: 2.0 * jnp.ones(3),
}
DIAGONALS = [[2.0] * 6, np.arange(1.0, 7), [1, 1, 2, 2, 3, 3], np.arange(1.0, 7), [2.0] * 6]


@pytest.mark.parametrize(("name", "expected"), [*zip(MASSES, DIAGONALS, strict=True)])
def test_masses_at_nodes(name, expected):
    system = System.from_elements(Elements(spring, line(3)), mass=MASSES[name])
    np.testing.assert_allclose(system.mass(jnp.ones((3, 2)), PARAMS), expected)


def test_a_consistent_mass_and_its_product_are_one():
    """Beside what sits at nodes, and with a node that is held."""
    q = jnp.asarray(np.random.default_rng(1).normal(size=(5, 2)))
    w = jnp.asarray(np.random.default_rng(2).normal(size=(5, 2)))
    lengths = np.linalg.norm(np.diff(q, axis=0), axis=1)
    M = np.diag([0.5] * 5)
    for (a, b), m in zip(line(5), lengths, strict=True):
        M[np.ix_([a, b], [a, b])] += m / 6 * np.array([[2, 1], [1, 2]])
    M = np.kron(M, np.eye(2))
    system = System.from_elements(Elements(spring, line(5)), mass=[0.5, Elements(bar, line(5))])
    np.testing.assert_allclose(full_matrix(system.mass(q, PARAMS)), M, rtol=1e-12)
    np.testing.assert_allclose(system.inertia(q, w, PARAMS).ravel(), M @ w.ravel(), rtol=1e-12)
    held = System.from_elements(Elements(spring, line(5)), mass=[0.5, Elements(bar, line(5))], held={0: True})
    M[:2], M[:, :2], M[:2, :2] = 0, 0, np.eye(2)
    np.testing.assert_allclose(full_matrix(held.mass(q, PARAMS)), M, rtol=1e-12)
    np.testing.assert_allclose(held.inertia(q, w, PARAMS).ravel(), M @ w.ravel(), rtol=1e-12)


@pytest.mark.slow
def test_a_small_system_with_a_consistent_mass():
    """Too small for a sparse solve: its mass is a full matrix, and no solve leaves the program."""
    system, q0, v0 = chain(3, mass=Elements(bar, line(3)), held=None)
    flat, q, _ = flatten("simulate", system, q0, v0, 0.0, PARAMS)
    assert flat.sparse is None
    assert not isinstance(flat.mass(q, 0.0, PARAMS), Sparse)
    found = run((system, q0, v0), num_steps=3)
    found.check()
    assert found.info.solve_residual is None


# ----------------------------------------------------------------------------
# What is held.


@pytest.mark.slow
def test_what_is_held_is_where_it_is_told_to_be(runs):
    t = runs("driven").t
    for name in ("driven", "consistent"):
        found = runs(name)
        np.testing.assert_allclose(found.q[:, 0, 0], 0.1 * np.sin(5 * t), atol=1e-15)
        np.testing.assert_allclose(found.v[:, 0, 0], 0.5 * np.cos(5 * t), atol=1e-15)
        np.testing.assert_allclose(found.acceleration[:, 0, 0], -2.5 * np.sin(5 * t), atol=1e-2)


@pytest.mark.slow
def test_a_rotation_is_where_it_is_told_to_be(runs):
    found = runs("bodies")
    told = jax.vmap(lambda t: spun(t, None)["R"])(found.t)
    np.testing.assert_allclose(found.q["R"][:, 0], told, atol=1e-14)
    np.testing.assert_allclose(found.v["R"][-1, 0], [0.5, 0.0, 0.06], atol=1e-3)


@pytest.mark.slow
def test_no_reaction_of_a_joint_moves_a_node_that_stays(runs):
    """Links behind one that stays swing as those that hang on a pin."""
    held, hung = run(links(6, grounded=False, held={0: True})), runs("links")
    for x in held.q.values():
        np.testing.assert_array_equal(x[:, 0], np.broadcast_to(x[0, 0], x[:, 0].shape))
    np.testing.assert_allclose(held.q["r"][:, 1:, 0] - 1, hung.q["r"][..., 0], atol=1e-12)
    np.testing.assert_allclose(held.q["angle"][:, 1:], hung.q["angle"], atol=1e-12)
    side = np.append([-1.0, -1.0], np.ones(8))  # from which the first joint is seen
    np.testing.assert_allclose(held.multipliers, hung.multipliers * side[None, :], atol=1e-9)


@pytest.mark.slow
def test_what_stays_stays_beside_dampers():
    """Of which a start takes the symmetric part."""
    held = {0: True, (2, 4): [[True, False], [False, True]]}
    system, q0, v0 = chain(9, held=held)
    found = run((system, q0, v0.at[1].set(1.0).at[3].set(-1.0)), {"c": 10.0}, num_steps=5)
    still = np.zeros((9, 2), bool)
    still[0], still[2, 0], still[4, 1] = True, True, True
    np.testing.assert_array_equal(np.ptp(found.q, axis=0) > 1e-14, ~still)


STARTS = {
    "q0": (shaken, 0.0, 0.5, 1.0),
    "v0": (shaken, 0.0, 0.4, 0.0),
    "v0 of what stays": (True, 0.0, 0.5, 0.0),
}


@pytest.mark.parametrize("name", STARTS)
def test_a_start_that_is_not_what_is_held(name):
    how, t0, rate, off = STARTS[name]
    system, q0, v0 = chain(9, held={0: how})
    start = q0.at[0, 0].add(off), v0.at[0, 0].set(rate)
    with pytest.raises(
        ValueError, match=rf"simulate: `{name[:2]}` of node 0 must be what `held` prescribes at the start"
    ):
        hhtjax.simulate(system, hhtjax.hht(), *start, PARAMS, dt=0.01, num_steps=1, t0=t0)
    sweep = {"dts": jnp.array([0.01]), "duration": 0.1, "num_samples": 1}
    with pytest.raises(ValueError, match=rf"sweep: `{name[:2]}` of node 0 must be"):
        hhtjax.sweep(system, hhtjax.hht(), *start, PARAMS, **sweep)


# ----------------------------------------------------------------------------
# Derivatives, batches and orders.


def derivatives(scene, key, solve):
    """Of the end of a run in a parameter, and in the start."""
    system, q0, v0 = scene

    def end(x, shift):
        found = run((system, jax.tree.map(lambda q: q + shift, q0), v0), {key: x}, num_steps=4, solve=solve)
        return sum(jnp.sum(q[-1] ** 2) for q in jax.tree.leaves(found.q))

    return end, jax.jit(jax.grad(end, (0, 1)))


@pytest.mark.slow
@pytest.mark.parametrize(("make", "key"), [(driven, "k"), (lambda: links(3), "g")], ids=["driven", "links"])
def test_derivatives_are_those_of_the_dense_solve_and_of_differences(make, key):
    x, h = PARAMS[key], 1e-4 * PARAMS[key]
    (end, sparse), (_, dense) = (derivatives(make(), key, solve) for solve in (None, by_lapack))
    slope, in_start = sparse(x, 0.0)
    np.testing.assert_allclose((slope, in_start), dense(x, 0.0), rtol=1e-9)
    both = jax.jit(lambda x, shift, *along: jax.jvp(end, (x, shift), along))
    np.testing.assert_allclose(both(x, 0.0, 1.0, 0.0)[1], slope, rtol=1e-9)
    ahead, back = (both(x + dx, 0.0, 1.0, 0.0)[0] for dx in (h, -h))
    np.testing.assert_allclose(slope, (ahead - back) / (2 * h), rtol=1e-5)
    if make is not driven:  # whose start is no free one
        np.testing.assert_allclose(both(x, 0.0, 0.0, 1.0)[1], in_start, rtol=1e-9)


@pytest.mark.slow
def test_a_batch_is_one_run_after_the_other():
    scene = lattice(6, joints=False)  # for SuperLU
    find = lambda k: run(scene, {"k": k}, num_steps=3).q[-1]  # noqa: E731
    k = jnp.array([150.0, 250.0])
    np.testing.assert_allclose(jax.vmap(find)(k), jnp.stack([find(x) for x in k]), atol=1e-13)


def orders(scene, dts, duration):
    """The observed orders of the positions, each step beside a far smaller one."""
    system, q0, v0 = scene
    stepper = hhtjax.hht(linearize="predictor")
    dts = jnp.asarray([*dts, dts[-1] / 8])
    q = hhtjax.sweep(system, stepper, q0, v0, PARAMS, dts=dts, duration=duration, num_samples=1).q
    errors = [distance(*(jax.tree.map(lambda x: x[i, -1], q) for i in (i, -1))) for i in range(len(dts) - 1)]  # noqa: B023
    return np.log2(np.divide(errors[:-1], errors[1:]))


@pytest.mark.slow
@pytest.mark.parametrize("make", [driven, links, bodies])
def test_order_two(make):
    dts = {driven: (4e-3, 2e-3, 1e-3), links: (8e-3, 4e-3, 2e-3), bodies: (8e-3, 4e-3, 2e-3)}[make]
    np.testing.assert_allclose(orders(make(3) if make is links else make(), dts, 0.16), 2.0, atol=0.15)


# ----------------------------------------------------------------------------
# What fails, and how it is called.


def test_a_joint_that_depends_on_others_is_named_at_the_start():
    system, q0, v0 = links(5, Joints(pin, [[2, 3]]))
    with pytest.raises(ValueError, match=r"simulate: `constraint` row"):
        run((system, q0, v0))


@pytest.mark.slow
def test_a_joint_that_comes_to_depend_on_others_is_named():
    """The point is at rest between two rods, of which the second becomes the first."""

    def second(q, t, params):
        return jnp.where(t < 0.045, q[1, 1:] - 0.8, rod(q, t, params))

    joints = Joints(rod, [[0, 1]]), Joints(second, [[0, 1]])
    places = np.stack([np.append(0, 0.6 + 0.9 * np.arange(8)), np.append(0, [0.8] * 8)], axis=1)
    found = run(net(line(9)[1:], places, *joints, held={0: True}))
    with pytest.raises(hhtjax.SimulationError, match=r"step 5 .* failed: row 1 of the constraint depends on"):
        found.check()


def off(name):
    """A system with something wrong, made as it is used."""
    pairs, springs = line(3), Elements(spring, line(3))
    made = {
        "node": lambda: System.from_elements(Elements(spring, line(4)), mass=1.0),
        "force": lambda: System.from_elements(Elements(lambda q, v, t, params: q[0], pairs), mass=1.0),
        "joint": lambda: System.from_elements(springs, Joints(lambda q, t, params: q[0, 0], pairs), mass=1.0),
        "set": lambda: System.from_elements(Elements(across, {"point": pairs, "plate": pairs}), mass=1.0),
        "each": lambda: System.from_elements(Elements(scaled, pairs, each=lambda params: {"k": jnp.ones(3)}), mass=1.0),
        "mass": lambda: System.from_elements(springs, mass=np.ones(5)),
        "mass of a key": lambda: System.from_elements(springs, mass={"r": 1.0}),
        "held node": lambda: System.from_elements(springs, mass=1.0, held={3: True}),
        "held flags": lambda: System.from_elements(springs, mass=1.0, held={0: [True, False, True]}),
        "held shape": lambda: System.from_elements(springs, mass=1.0, held={0: lambda t, params: jnp.stack([t] * 3)}),
        "nodes": lambda: Elements(spring, [0, 1]),
        "large nodes": lambda: Elements(spring, [[0, 2**40]]),
        "rows of each": lambda: Elements(scaled, pairs, each=np.ones(5)),
        "negative mass": lambda: System.from_elements(springs, mass=-1.0),
        "flags": lambda: System.from_elements(springs, mass=1.0, held={0: 3}),
        "key of held": lambda: System.from_elements(springs, mass=1.0, held={-1: True}),
        "part": lambda: System.from_elements(spring, mass=1.0),
        "function": lambda: Elements(lambda q: q, pairs),
        "function with each": lambda: System.from_elements(Elements(spring, pairs, each=1.0), mass=1.0),
        "mass function": lambda: System.from_elements(springs, mass=springs),
        "two masses": lambda: System.from_elements(springs, mass=[1.0, 2.0, Elements(bar, pairs)]),
    }[name]()
    return run((made, jnp.ones((3, 2)), jnp.zeros((3, 2))), num_steps=1)


WRONG = {
    "node": r"Elements: `nodes` contains node 3, but a leaf of the state has shape \(3, 2\)",
    "force": r"`function` must return a force .* of shapes \(2, 2\); received \(2,\)",
    "joint": r"Joints: `function` must return the rows \(m,\) of one joint; received shape \(\)",
    "set": "Elements: `nodes` must be an array, because the position is not a dict; received the keys",
    "each": r"Elements: `each\['k'\]` must be a number, or have one row for each .* received shape \(3,\)",
    "mass": r"a leaf of `mass` must .* of shape \(3, 2\); received shape \(5,\)",
    "mass of a key": r"`mass` must be structured like v, or have shape \(6,\); received",
    "held node": r"`held` names node 3, but a leaf of the state has shape \(3, 2\)",
    "held flags": r"booleans of `held` must have the shape \(2,\) of their nodes; received shape \(3,\)",
    "held shape": r"the result of `held` for \(0,\) must have their shape \(2,\); received shape \(3,\)",
    "nodes": r"Elements: `nodes` must be an array \(E, k\) of integers",
    "large nodes": r"Elements: `nodes` must be an array \(E, k\) of integers",
    "rows of each": r"Elements: `each` must be a number, or have one row for each of the 2 rows",
    "negative mass": "`mass` must be finite, and nowhere negative; received -1.0",
    "flags": r"`held\[0\]` must be True, booleans structured like a node, or a function \(t, params\); received 3",
    "key of held": "the keys of `held` must be nodes, or tuples of nodes; received -1",
    "part": "give Elements and Joints; received",
    "function": r"Elements: `function` is called as function\(q, v, t, params\); received a function of 1",
    "function with each": r"is called as function\(q, v, t, params, each\); received a function of 4",
    "mass function": r"`mass` is called as mass\(q, w, params\); received a function of 4",
    "two masses": "`mass` must hold one mass at the nodes, and Elements; received",
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name):
    with pytest.raises((TypeError, ValueError), match=WRONG[name]):
        off(name)


@pytest.mark.slow
def test_other_steppers_solve_elements_or_refuse(runs):
    end = runs("driven").q[-1]
    for stepper in (hhtjax.rk4(), hhtjax.rodas5p(), hhtjax.extrapolated()):
        system, q0, v0 = driven()
        found = hhtjax.simulate(system, stepper, q0, v0, PARAMS, dt=0.01, num_steps=10).q[-1]
        np.testing.assert_allclose(found, end, atol=1e-3)
    system, q0, v0 = links()
    with pytest.raises(NotImplementedError, match="rodas5p cannot solve the `constraint`"):
        hhtjax.simulate(system, hhtjax.rodas5p(), q0, v0, PARAMS, dt=0.01, num_steps=1)


@pytest.mark.slow
def test_redundant_joints_by_least_squares(runs):
    found = run(links(5, Joints(pin, [[2, 3]])), redundant="least_squares", start="simple")
    found.check()
    assert distance(found.q, runs("links").q) < 1e-9


@pytest.mark.slow
def test_an_impact_of_a_node():
    system, q0, v0 = chain(9)
    event = hhtjax.Event(lambda q, v, t, params: q[5, 1] + 0.15, hhtjax.impact(0.5))
    stepper, more = hhtjax.hht(linearize="predictor", start="simple"), {"events": [event], "max_events": 4}
    found = hhtjax.simulate(system, stepper, q0, v0, PARAMS, dt=0.01, num_steps=20, **more)
    found.check()
    assert np.min(found.q[:, 5, 1]) > -0.15 - 1e-9
    assert np.max(np.diff(found.v[:, 5, 1])) > 0.3


def test_weights_of_nodes_alone_fall():
    """No element meets another: the sparse solve has a diagonal matrix."""
    system = System.from_elements(Elements(weight, np.arange(20)[:, None]), mass=2.0)
    found = run((system, jnp.zeros((20, 2)), jnp.zeros((20, 2))))
    np.testing.assert_allclose(found.q[-1, :, 1], -PARAMS["g"] / 2 * 0.1**2 / 2, rtol=1e-12)


def test_the_default_step_expands_about_the_state_that_a_dense_one_does():
    system, q0, v0 = chain()

    def ends(k, **options):
        params = PARAMS | {"k": k}
        return hhtjax.simulate(system, hhtjax.hht(**options), q0, v0, params, dt=0.1, num_steps=6, save_every=6).q[-1]

    k = jnp.array([20.0, 2e4])
    found, dense = (jax.jit(jax.vmap(lambda k, o=o: ends(k, **o)))(k) for o in ({}, {"solve": by_lapack}))
    np.testing.assert_allclose(found, dense, rtol=0, atol=1e-8)
    np.testing.assert_allclose(jax.jit(ends)(k[1]), dense[1], rtol=0, atol=1e-8)
    elsewhere = jax.jit(lambda k: ends(k, linearize="predictor"))(k[1])
    assert float(jnp.max(jnp.abs(elsewhere - dense[1]))) > 1e-3  # else no step of it was about the held state
