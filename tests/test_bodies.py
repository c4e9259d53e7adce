"""Mechanisms from bodies and joints: their equations, slopes, order, gradients, loops, friction, motors and ends."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import check_gradient
from jax.flatten_util import ravel_pytree
from mechanisms import four_bar, random_tree, servo_arm

import hhtjax
from hhtjax import bodies
from hhtjax.bodies import Body, Connect, Couple, Joint, Motor, Weld, tree
from hhtjax.bodies import newton_euler as ne
from hhtjax.bodies.equations import inertia_of, position, rates
from hhtjax.bodies.model import numpy_mass_matrix
from hhtjax.rotation import exp
from hhtjax.systems import kinematics

ALL = ("free", "ball", "revolute", "prismatic", "planar", "ball")
BRANCHED = (-1, 0, 1, 1, 0, 4)


def state(robot, seed=0):
    """A random position, v and w, structured."""
    rng = np.random.default_rng(seed)
    _, unravel = ravel_pytree(robot.v0)
    n = robot.model.tree.rates
    blocks, (q, back) = kinematics.layout(robot.q0, robot.v0), ravel_pytree(robot.q0)
    q = back(kinematics.move(blocks, q, jnp.asarray(rng.normal(size=n))))
    return q, *(unravel(jnp.asarray(x)) for x in rng.normal(size=(2, n)))


def energy(robot, q, v):
    """Kinetic, and that of gravity, of springs of hinges and slides: by the frames of the bodies alone."""
    p, kinetic, potential = robot.params, 0.0, 0.0
    (frames, rate) = jax.jvp(robot.frames, (q,), (along(robot, q, v),))
    for i, name in enumerate(robot.bodies):
        (R, x), (dR, dx) = frames[name], rate[name]
        Om = ne.axial(R.T @ dR) / 2
        u = dx + dR @ p["com"][i]
        kinetic += (p["mass"][i] * u @ u + Om @ p["inertia"][i] @ Om) / 2
        potential -= p["mass"][i] * p["gravity"] @ (x + R @ p["com"][i])
    flat = rates(robot.model.tree, v)
    return kinetic + jnp.sum(p["armature"] * flat**2) / 2, potential


def along(robot, q, v):
    """The rate of q."""
    blocks, (flat, back) = kinematics.layout(q, v), ravel_pytree(q)
    return back(kinematics.rate(blocks, flat, ravel_pytree(v)[0]))


@pytest.mark.parametrize("parents", [None, BRANCHED])
def test_equations_are_those_of_the_energy(parents):
    """M is the Hessian of the kinetic energy, and v.(bias) = dT/dt at M w = 0 less what gravity does; M by NumPy."""
    robot = random_tree(ALL, parents=parents)
    q, v, w = state(robot)
    flat, unravel = ravel_pytree(v)

    @jax.jit
    def expected(flat):
        T, power = jax.hessian(lambda x: energy(robot, q, unravel(x))[0])(flat), None

        def total(s):
            blocks, (at, back) = kinematics.layout(q, v), ravel_pytree(q)
            moved = back(kinematics.move(blocks, at, s * flat))
            return sum(energy(robot, moved, v))

        power = jax.jvp(total, (0.0,), (1.0,))[1]
        return T, power

    M, power = expected(flat)
    found = jax.jit(partial(bodies.mass_matrix, robot))(q)
    np.testing.assert_allclose(found, M, rtol=1e-12, atol=1e-12)
    by_numpy = numpy_mass_matrix(robot.model, jax.tree.map(np.asarray, q), robot.params)
    np.testing.assert_allclose(by_numpy, M, rtol=1e-12, atol=1e-12)
    zero = unravel(0 * flat)
    bias = ravel_pytree(jax.jit(partial(bodies.inverse_dynamics, robot))(q, v, zero))[0]
    assert float(flat @ bias) == pytest.approx(float(power), rel=1e-11)
    w_flat = ravel_pytree(w)[0]
    whole = ravel_pytree(jax.jit(partial(bodies.inverse_dynamics, robot))(q, v, w))[0]
    np.testing.assert_allclose(whole - bias, M @ w_flat, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("parents", [None, BRANCHED])
def test_slopes_are_those_of_autodiff(parents):
    robot = random_tree(ALL, parents=parents)
    own, params = robot.model.tree, robot.params
    q, v, w = state(robot, 1)
    p, v, w = position(own, q), rates(own, v), rates(own, w)
    links = inertia_of(robot.model, params)

    @partial(jax.jit, static_argnums=0)
    def slopes_of(function, x, v, w, mass, gravity):
        nr, nf = own.balls, own.frees
        R = jax.vmap(lambda R, psi: R @ exp(psi))(p.R, x[: 3 * nr].reshape(-1, 3))
        at = ne.Position(p.x + x[3 * (nr + nf) :], R, p.y + x[3 * nr : 3 * (nr + nf)].reshape(-1, 3))
        return function(own, at, v, w, links._replace(m=mass), gravity)

    at = jnp.zeros(own.rates), v, w, links.m, params["gravity"]
    every = (1, 2, 3, 4, 5)
    plain = jax.jacfwd(slopes_of, every)(ne.plain_inverse_dynamics, *at)
    closed = jax.jacfwd(slopes_of, every)(ne.inverse_dynamics, *at)
    for x, y in zip(closed, plain, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-13 * max(1.0, float(np.abs(y).max())))
    found = ne.slopes(own, p, v, w, links, params["gravity"])
    np.testing.assert_allclose(found.q, plain[0], rtol=0, atol=1e-13 * float(np.abs(plain[0]).max()))
    np.testing.assert_allclose(found.value, slopes_of(ne.inverse_dynamics, *at), rtol=1e-13)


@pytest.fixture(scope="module")
def tumbling():
    """A free body with a ball and a hinge on it; its end by small steps of the trapezoidal rule."""
    robot = random_tree(("free", "ball", "revolute"), seed=3)
    rng = np.random.default_rng(3)
    v0 = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), robot.v0)
    fine = hhtjax.simulate(
        robot.system, hhtjax.newmark(), robot.q0, v0, robot.params, dt=2e-4, num_steps=2000, save_every=2000
    )
    return robot, v0, jax.tree.map(lambda x: x[-1], fine.q)


@pytest.mark.slow
def test_order_two_for_every_alpha(tumbling):
    """With a free joint, a ball and a hinge; one program for all."""
    robot, v0, expected = tumbling
    expected = ravel_pytree(expected)[0]
    ends = {}
    for alpha in (0.0, -0.1, -1 / 3):
        run = hhtjax.sweep(
            robot.system, hhtjax.hht(jnp.asarray(alpha)), robot.q0, v0, robot.params,
            dts=[0.02, 0.01, 0.005], duration=0.4, num_samples=1,
        )  # fmt: skip
        lasts = [ravel_pytree(jax.tree.map(lambda x, i=i: x[i, -1], run.q))[0] for i in range(3)]
        errors = [float(jnp.linalg.norm(last - expected)) for last in lasts]
        ends[alpha] = np.log2(np.array(errors[:-1]) / errors[1:])
    for alpha, slopes in ends.items():
        np.testing.assert_allclose(slopes, 2, atol=0.15, err_msg=str(alpha))


@pytest.mark.slow
def test_derivatives_in_entries_of_an_inertia_are_symmetric():
    """So a descent keeps it the inertia of a body: the closed slopes take it for symmetric, plain ones would not."""
    robot = random_tree(("revolute", "revolute"))
    q, v, w = state(robot)

    def torque(inertia):
        """Slopes times a change, as in a step."""
        r = partial(bodies.inverse_dynamics, robot, params=robot.params | {"inertia": inertia})
        return jnp.sum(jnp.sin(jax.jvp(lambda q, v: r(q, v, w), (q, v), (v, w))[1]))

    slope = jax.grad(torque)(jnp.asarray(robot.params["inertia"]))
    assert float(jnp.max(jnp.abs(slope))) > 0.01
    np.testing.assert_allclose(slope, jnp.swapaxes(slope, 1, 2), rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_gradients_in_all_inertial_params():
    """Forward = reverse = central differences, through the closed slopes and their derivatives."""
    robot = random_tree(("revolute", "ball"), seed=5)
    names = ("mass", "com", "inertia", "damping", "armature", "gravity")

    def end(some):
        run = hhtjax.simulate(
            robot.system,
            hhtjax.hht(-0.1),
            robot.q0,
            robot.v0,
            robot.params | some,
            dt=0.02,
            num_steps=10,
            save_every=10,
        )
        return sum(jnp.sum(jnp.sin(x[-1])) for x in jax.tree.leaves((run.q, run.v)))

    check_gradient(end, {name: robot.params[name] for name in names})


def test_a_four_bar_closes_and_keeps_closed():
    """Two rows of the pin's three say all; the gap stays at rounding; one freedom."""
    robot = four_bar()
    assert len(robot.model.rows) == 2
    ends = [robot.frames(robot.q0)[name] for name in ("coupler", "rocker")]
    tips = [f.x + f.R @ jnp.array([x, 0, 0]) for f, x in zip(ends, (0.8, 0.5), strict=True)]
    np.testing.assert_allclose(tips[0], tips[1], atol=1e-12)
    run = hhtjax.simulate(robot.system, hhtjax.hht(), robot.q0, robot.v0, robot.params, dt=1e-3, num_steps=300)
    run.check()
    gap = jax.vmap(lambda q: bodies.equations.Loops(robot.model._replace(rows=None))(q, 0.0, robot.params))(run.q)
    assert float(jnp.max(jnp.abs(gap))) < 1e-11
    assert float(jnp.max(jnp.abs(run.q[-1] - run.q[0]))) > 0.01


def test_loops_that_cannot_be_closed_are_refused():
    one = Body("bar", joints=Joint(axis=(0, 1, 0)), mass=1.0, com=(0.5, 0, 0), inertia=(0.1, 0.1, 0.1))
    with pytest.raises(ValueError, match="cannot be closed from the described position: 1 m"):
        tree([one], loops=[Connect("world", "bar", (2.0, 0, 0), (1.0, 0, 0))])
    with pytest.raises(ValueError, match="constrain nothing that moves"):
        tree([one], loops=[Connect("world", "bar")])
    with pytest.raises(ValueError, match="`loops` names 'rod'"):
        tree([one], loops=[Connect("world", "rod")])
    pin = Body("pin", "bar", Joint("revolute", friction=0.1), position=(1.0, 0, 0))
    with pytest.raises(ValueError, match="the joint 'pin' of `bodies` must move some inertia"):
        tree([one, pin], loops=[Weld("pin", "world", anchor2=(1.0, 0, 0))])


def test_couplings_hold_and_weld():
    """A follower turns by its polynomial; a welded body keeps its place and orientation."""
    joint = {"axis": (0, 1, 0), "damping": 0.2}
    bar = {"mass": 1.0, "com": (0.2, 0, 0), "inertia": (0.1, 0.1, 0.1)}
    robot = tree(
        [
            Body("driver", joints=Joint(**joint), **bar),
            Body("follower", joints=Joint(**joint), position=(1, 0, 0), **bar),
            Body("held", joints=Joint("free"), position=(0.5, 0, 0), **bar),
        ],
        loops=[Couple("follower", "driver", (0.1, -2.0, 0.3)), Weld("driver", "held", (0.5, 0, 0))],
    )
    driver, follower = robot.q0["joint"]
    assert follower == pytest.approx(0.1 - 2 * driver + 0.3 * driver**2)
    run = hhtjax.simulate(robot.system, hhtjax.hht(), robot.q0, robot.v0, robot.params, dt=5e-3, num_steps=60)
    run.check()
    driver, follower = run.q["joint"].T
    np.testing.assert_allclose(follower, 0.1 - 2 * driver + 0.3 * driver**2, atol=1e-11)
    end = robot.frames(jax.tree.map(lambda x: x[-1], run.q))
    np.testing.assert_allclose(end["held"].R, end["driver"].R, atol=1e-11)
    np.testing.assert_allclose(end["held"].x, end["driver"].x + end["driver"].R @ jnp.array([0.5, 0, 0]), atol=1e-11)


def test_a_weld_half_a_turn_off_is_refused_and_one_far_off_is_told_of():
    """Half a turn off the rows of a weld vanish, too."""
    free = {"joints": Joint("free"), "mass": 1.0, "inertia": (0.1, 0.1, 0.1)}
    with pytest.warns(UserWarning, match=r"open by 0.84 m or rad.* moved by up to 0.84 .* check `anchor1`") as told:
        tree([Body("b", rotation=(np.cos(0.5), np.sin(0.5), 0, 0), **free)], loops=[Weld("world", "b")])
    assert told[0].filename == __file__
    with pytest.raises(ValueError, match="error of half a turn"):
        tree([Body("b", rotation=(0.05, 1.0, 0, 0), **free)], loops=[Weld("world", "b")])


def test_more_rows_than_coordinates_are_a_matter_of_redundancy():
    """All three rows of a pin, twice, on two coordinates of a bar: refused as dependent, and run as least squares."""
    robot = four_bar()
    whole = bodies.equations.Loops(robot.model._replace(rows=None))
    system = hhtjax.System(
        robot.system.mass, dynamics=robot.system.dynamics,
        constraint=lambda q, t, params: jnp.tile(whole(q, t, params), 2),
    )  # fmt: skip
    args = system, robot.q0, robot.v0, robot.params
    with pytest.raises(ValueError, match=r"rows \[1, 4\] have no gradient"):
        hhtjax.simulate(args[0], hhtjax.hht(), *args[1:], dt=1e-3, num_steps=20)
    stepper = hhtjax.hht(redundant="least_squares")
    run = hhtjax.simulate(args[0], stepper, *args[1:], dt=1e-3, num_steps=20)
    run.check()
    known = hhtjax.simulate(robot.system, hhtjax.hht(), *args[1:], dt=1e-3, num_steps=20)
    np.testing.assert_allclose(run.q, known.q, atol=1e-9)


def test_dynamics_that_is_not_affine_is_refused():
    """Where its slope reads w; a piecewise form of an affine one is let through."""
    one = jnp.ones(2)

    def run(dynamics, params=None):
        system = hhtjax.System(dynamics=dynamics)
        return hhtjax.simulate(system, hhtjax.hht(), one, one, params, dt=0.1, num_steps=1)

    with pytest.raises(ValueError, match=r"simulate: `dynamics` must be affine in w, .*= 0.0134 in row 1, at q0 and"):
        run(lambda q, v, w, t, params: params * w * (1 + jnp.array([0.0, 1e-3]) * w), 2.0)
    run(lambda q, v, w, t, params: jnp.where(w > 0, 2.0, 2.0) * w + q)


def test_servo_and_dry_friction():
    """The arm holds where the servo's torque, less gravity's, is below the friction."""
    robot = servo_arm()
    assert robot.rubbing == (0, 1)
    assert robot.motors == ("upper", "fore")
    run = hhtjax.simulate(
        robot.system, hhtjax.hht(), robot.q0, robot.v0, robot.params | {"ctrl": jnp.array([0.1, 0.2])},
        dt=2e-3, num_steps=1000, save_every=1000,
    )  # fmt: skip
    run.check()
    assert bool(jnp.all(run.sticking[-1]))
    still = bodies.inverse_dynamics(robot, run.q[-1], robot.v0, robot.v0)
    driven = bodies.forces(robot, run.q[-1], robot.v0, 0.0, robot.params | {"ctrl": jnp.array([0.1, 0.2])})
    np.testing.assert_allclose(driven - still, run.friction[-1], atol=1e-6)
    assert float(jnp.max(jnp.abs(run.q[-1] - jnp.array([0.1, 0.2])))) < 0.05


def test_motors_clip_and_outer_loads_act():
    """F of a motor by its formula and its ranges; torque and wrench as the virtual work says."""
    link = {"mass": 1.0, "inertia": (0.1, 0.1, 0.1), "com": (0.3, 0, 0)}
    robot = tree(
        [
            Body("a", joints=Joint(axis=(0, 1, 0)), **link),
            Body("b", "a", Joint("prismatic", (1, 0, 0)), position=(0.5, 0, 0), **link),
        ],
        motors=[
            Motor("a", "torque", gear=3.0, gain=2.0, ctrlrange=(-1, 1), offset=0.5),
            Motor("b", "velocity", kv=4.0, forcerange=(-2, 2)),
        ],
        gravity=(0, 0, 0),
    )  # fmt: skip
    q, v = jnp.array([0.3, 0.1]), jnp.array([0.2, -0.1])

    def acting(**params):
        return bodies.forces(robot, q, v, 0.5, robot.params | params)

    np.testing.assert_allclose(acting(ctrl=jnp.array([0.4, 0.2])), [3 * (0.8 + 0.5), 4 * (0.2 + 0.1)])
    np.testing.assert_allclose(acting(ctrl=jnp.array([9.0, 9.0])), [3 * 2.5, 2.0])
    np.testing.assert_allclose(acting(ctrl=jnp.array([1, 0])), acting(ctrl=jnp.array([1.0, 0.0])))
    with pytest.raises(ValueError, match=r'params\["ctrl"\] must be'):
        acting(ctrl=jnp.ones(1))
    np.testing.assert_allclose(acting(ctrl=lambda t: jnp.array([t, 0.0])), [3 * 1.5, 0.4])
    rest = acting()
    np.testing.assert_allclose(acting(torque=lambda t: jnp.array([t, 1.0])) - rest, [0.5, 1.0])
    wrench = jnp.array([0.1, 0.2, -0.3, 1.0, -2.0, 0.5])

    def moved(dq):
        frame = robot.frames(q + dq)["b"]
        start = robot.frames(q)["b"]
        return wrench[:3] @ ne.axial(frame.R @ start.R.T) / 2 + wrench[3:] @ frame.x

    np.testing.assert_allclose(acting(wrench={"b": wrench}) - rest, jax.grad(moved)(0 * q), atol=1e-14)
    with pytest.raises(ValueError, match="'c'"):
        acting(wrench={"c": wrench})


@pytest.mark.parametrize("limits", ["stop", "event"])
def test_ends_of_ranges(limits):
    """A pendulum that falls onto the end of its range comes back."""
    bar = Body(
        "bar", joints=Joint(axis=(0, 1, 0), range=(-2.0, 0.4)), mass=1.0, com=(0.5, 0, 0), inertia=(0.1, 0.1, 0.1)
    )
    with pytest.raises(ValueError, match="give limits="):
        tree([bar])
    robot = tree([bar], limits=limits)
    run = hhtjax.simulate(
        robot.system, hhtjax.hht(), robot.q0, robot.v0, robot.params, dt=1e-3, num_steps=400, events=robot.events
    )
    run.check()
    assert robot.events is None if limits == "stop" else len(robot.events) == 2
    assert 0.39 < float(jnp.max(run.q)) < 0.42
    assert float(run.v[jnp.argmax(run.q[:, 0]) + 30, 0]) < -0.05


def test_positions_may_be_free():
    """The same motion, and a derivative of places in the offset of a link."""
    made = [random_tree(("revolute", "prismatic", "ball"), seed=7, free=free) for free in ((), ("position",))]
    q, v, w = state(made[0])
    for f in (bodies.inverse_dynamics, lambda robot, q, v, w: robot.frames(q)):
        same = [jax.jit(partial(f, robot))(q, v, w) for robot in made]
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-12), *same)
    robot = made[1]
    fixed = Body("plate", position=(0, 0, 9.0), mass=1.0)
    mixed = tree([fixed, Body("a", "plate", Joint(), **BODY), Body("b", "a"), Body("c", "b", Joint(), **BODY)],
                 free=("position",))  # fmt: skip
    assert mixed.bodies == ("a", "c")  # and behind them the plate and b
    moved = mixed.params | {"position": jnp.arange(12.0).reshape(4, 3)}
    found = mixed.frames(mixed.q0, moved)
    for name, parent, row in (("a", "plate", 0), ("c", "b", 1), ("plate", "world", 2), ("b", "a", 3)):
        np.testing.assert_allclose(found[name].x - found[parent].x, moved["position"][row], atol=1e-14)

    def torque(x):
        found = bodies.inverse_dynamics(robot, q, v, w, robot.params | {"position": robot.params["position"] + x})
        return jnp.sum(jnp.sin(ravel_pytree(found)[0]))

    check_gradient(torque, jnp.zeros((3, 3)))


def test_regressor_is_linear_in_theta():
    robot = random_tree(("revolute", "ball", "prismatic"), seed=2)
    q, v, w = state(robot)
    Y, theta = jax.jit(partial(bodies.regressor, robot))(q, v, w), bodies.inertial_parameters(robot.params)
    torque = ravel_pytree(bodies.inverse_dynamics(robot, q, v, w, robot.params | {"armature": jnp.zeros(5)}))[0]
    np.testing.assert_allclose(Y @ theta, torque, rtol=1e-11, atol=1e-12)


def beam_of(elements, **more):
    """Of 0.7 m, clamped, with 3 N m^2 about y and 5 N m^2 about z, 0.4 kg/m."""
    return tree(bodies.beam("b", length=0.7, elements=elements, EI=(3.0, 5.0), rhoA=0.4, **more), gravity=(0, 0, 0))


def frequencies(robot):
    """Of small vibrations about q0, rad/s, in increasing order."""
    M = numpy_mass_matrix(robot.model, np.asarray(robot.q0), robot.params)
    root = np.diag(1 / np.sqrt(robot.params["stiffness"]))
    return 1 / np.sqrt(np.linalg.eigvalsh(root @ M @ root)[::-1])


def test_a_beam_is_that_of_euler_and_bernoulli():
    """Tip deflection and frequencies, with errors of second order in the length of an element; damping; gradients."""
    L, EI, rhoA, F = 0.7, np.array([3.0, 5.0]), 0.4, np.array([0.2, -0.3])  # EI about y, z; F along z, y
    first = 1.8751040687**2 * np.sqrt(EI / rhoA) / L**2
    errors = []
    for n in (3, 6, 12):
        robot = beam_of(n)
        params = robot.params | {"wrench": {"b_tip": jnp.array([0, 0, 0, 0, F[1], F[0]])}}

        def tip(scale, robot=robot, params=params):
            bent = bodies.forces(robot, robot.q0, robot.v0, 0.0, params) / (scale * params["stiffness"])
            return jax.jvp(lambda q: robot.frames(q)["b_tip"].x, (robot.q0,), (bent,))[1]

        expected = F * L**3 / (3 * EI) * (1 - 1 / (4 * n**2))
        np.testing.assert_allclose(tip(1.0)[2:0:-1], expected, rtol=1e-12)
        errors.append(frequencies(robot)[:2] / first - 1)
    np.testing.assert_allclose(jax.jacfwd(tip)(1.0), -tip(1.0), rtol=1e-12)
    circle = robot.frames(jnp.tile(jnp.array([2 * np.pi / n, 0.0]), n))["b_tip"]  # by a moment 2 pi EI/L at the tip
    np.testing.assert_allclose(circle.x, 0, atol=1e-14)
    np.testing.assert_allclose(circle.R, np.eye(3), atol=1e-14)
    assert np.all(np.abs(errors[-1]) < 2e-3)
    np.testing.assert_allclose(np.log2(np.abs(np.array(errors[:-1]) / errors[1:])), 2, atol=0.1)
    twisting = beam_of(12, GJ=2.0, rhoI=(1e-4, 2e-4), damping=0.01, joints=Joint(axis=(0, 0, 1), stiffness=1e9))
    torsion = np.pi / 2 * np.sqrt(2.0 / 3e-4) / L
    assert np.min(np.abs(frequencies(twisting) / torsion - 1)) < 2e-3
    p = twisting.params
    np.testing.assert_allclose(p["damping"][1:], 0.01 * p["stiffness"][1:], rtol=1e-12)
    total = float(jnp.sum(p["mass"]))
    assert total == pytest.approx(rhoA * L)
    assert twisting.joints[:4] == ("b1", "b2_z", "b2_y", "b2_x")


def test_denavit_hartenberg_in_both_conventions():
    """The frame of each link is the product of the screws of its rows."""
    rows = np.array([[0.1, 0.5, 0.2, 0.3], [0.4, -1.2, 0.1, -0.2], [0.2, 0.7, -0.3, 0.9]])
    q = np.array([0.4, -0.8, 1.1])
    for modified in (False, True):
        robot = tree(bodies.denavit_hartenberg(rows, modified=modified, mass=[1.0] * 3, inertia=[(0.1, 0.1, 0.1)] * 3))
        T = np.eye(4)
        for (a, alpha, d, theta), angle in zip(rows, q, strict=True):
            turn, link = bodies.description._screw(2, theta + angle, d), bodies.description._screw(0, alpha, a)
            T = T @ (link @ turn if modified else turn @ link)
        found = robot.frames(jnp.asarray(q))["link3"]
        np.testing.assert_allclose(found.R, T[:3, :3], atol=1e-14)
        np.testing.assert_allclose(found.x, T[:3, 3], atol=1e-14)


BODY = {"mass": 1.0, "com": (0.1, 0, 0), "inertia": (0.1, 0.1, 0.1)}
WRONG = [
    (lambda: Joint("hinge"), "`kind` must be one of revolute"),
    (lambda: Joint(axis=(0, 0, 0)), "`axis` must be a direction"),
    (lambda: Joint(range=(1, 0)), r"\(lowest, highest\)"),
    (lambda: Joint("ball", rest=1.0), "`rest` belongs to revolute"),
    (lambda: Joint(damping=-1.0), "`damping` must be 0 or more"),
    (lambda: Body("b", mass=1.0, inertia=(1, 1, 3)), "none larger than the sum"),
    (lambda: Body("b", inertia=(1, 1, 1)), "has inertia but no mass"),
    (lambda: Body("world"), 'must not be "world"'),
    (lambda: Body("b", joints=[Joint("free"), Joint()]), "a free joint must be the only joint"),
    (lambda: Body("b", rotation=np.ones((3, 3))), "(?s)must be a rotation, .* off by 3 and has det R = 0"),
    (lambda: Body("b", rotation=(0, 0, 0, 0)), "a quaternion that is not zero"),
    (lambda: tree([Body("b", joints=Joint(), **BODY), Body("tip", "b", Joint())]), "joint 'tip' .* is singular"),
    (lambda: tree([Body("b", joints=Joint("ball"), mass=1.0, com=(0, 0, 0.5))]), "joint 'b' .* is singular"),
    (lambda: tree([Body("b", joints=[Joint(name="x"), Joint()], **BODY)]), "joints 'x', 'b_2' .* matrix is singular"),
    (lambda: Motor("a", "servo"), "torque, position or velocity"),
    (lambda: Motor("a", "position", gain=2.0), "`gain` belongs to torque motors"),
    (lambda: Motor("a", ctrlrange=(1, -1)), r"`ctrlrange` must be \(lowest"),
    (lambda: Motor("a", activation="muscle"), "`activation` must be integrator, filter or None; received 'muscle'"),
    (lambda: Motor("a", activation="filter"), "`timeconst` belongs to a motor with activation=\"filter\", which needs"),
    (lambda: Motor("a", activation="filter", timeconst=0.0), "`timeconst` must be positive; received 0"),
    (lambda: Motor("a", actrange=(0, 1)), "`actrange` belongs to motors with an activation"),
    (lambda: Joint("free", anchor=(1, 0, 0)), "turns about the origin of its body"),
    (lambda: tree([Body("b", "c", Joint(), **BODY)]), "must be a body before it; received 'c'"),
    (lambda: tree([Body("b", joints=Joint(), **BODY)] * 2), "two bodies are named 'b'"),
    (lambda: tree([Body("b", **BODY)]), "at least one joint"),
    (lambda: tree([Body("b", joints=Joint())]), "must have a mass"),
    (lambda: tree([Body("b", joints=Joint(), **BODY)], motors=[Motor("c")]), "`motors` names 'c'"),
    (lambda: tree([Body("b", joints=Joint(), **BODY)], friction="wet"), "`friction` must be one of 'dry'"),
    (lambda: bodies.denavit_hartenberg([[1, 2, 3]]), r"finite numbers \(N, 4\)"),
    (lambda: bodies.flexible(Joint(), 1e4), "with an armature"),
    (lambda: beam_of(0), "beam: `elements` must be a positive integer; received 0"),
    (lambda: beam_of(2, damping=-1.0), "beam: `damping` must be 0 or more; received -1"),
    (lambda: beam_of(2, GJ=1.0), "beam: `rhoI` must be 0 or more, and positive for a beam that twists"),
    (lambda: bodies.beam("b", length=1.0, elements=2, EI=(1, 2, 3), rhoA=1.0), r"one number, or \(about y, about z\)"),
    (lambda: bodies.beam("b", length=1.0, elements=2, EI=-1.0, rhoA=1.0), "beam: `EI` must be positive; received -1"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "words"), WRONG)
def test_a_wrong_description_is_refused(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


def test_unnamed_joints_of_a_body_are_told_apart():
    """The second is BODY_2, but for a spring behind the joint of a motor."""
    motor = Joint(axis=(0, 1, 0), armature=0.1)
    robot = tree([Body("a", joints=bodies.flexible(motor, 1e3), **BODY), Body("b", "a", [Joint(), motor], **BODY)])
    assert robot.joints == ("a", "a_spring", "b", "b_2")
    assert [robot.index(name) for name in robot.joints] == [0, 1, 2, 3]


def test_a_mechanism_is_drawn_by_its_bars():
    """A line from each joint to the next, and on to the end of the last body."""
    robot = servo_arm()
    upper, fore = robot.bars()(jnp.array([0.0, np.pi / 2]))
    np.testing.assert_allclose(upper, [[0, 0, 0], [0.4, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(fore, [[0.4, 0, 0], [0.4, 0, -0.4]], atol=1e-12)


def test_a_mechanism_can_be_made_where_something_is_traced():
    """With loops and stops, whose rows and stiffness are numbers."""
    made = jax.jit(lambda q: four_bar().frames(q)["rocker"].x)(jnp.zeros(3))
    np.testing.assert_allclose(made, four_bar().frames(jnp.zeros(3))["rocker"].x)


def test_params_that_would_be_ignored_are_refused():
    robot = four_bar()
    zero = jnp.zeros(3)
    for name in ("position", "ctrl", "frictionloss"):
        with pytest.raises(ValueError, match=f"{name}.* is not read"):
            robot.system.dynamics(zero, zero, zero, 0.0, robot.params | {name: jnp.zeros((3, 3))})
    with pytest.raises(NotImplementedError, match="redundant rows"):
        four_bar(free=("position",))


def test_arrays_of_another_shape_and_misspelt_params_are_refused():
    """Each would be broadcast, or ignored, without a word."""
    arm, z = servo_arm(), jnp.zeros
    q, v = z(2), z(2)
    floating = tree([Body("x", joints=Joint("free"), mass=1.0, inertia=(1, 1, 1.9))])
    wrong = [
        (lambda: bodies.mass_matrix(arm, z(3)), r"q must be an array of shape \(2,\)"),
        (lambda: bodies.mass_matrix(arm, q, arm.params | {"inertia": z((2, 3))}), r'params\["inertia"\] must be'),
        (lambda: bodies.forces(arm, q, v, 0.0, arm.params | {"torque": z(1)}), r'params\["torque"\] must be'),
        (lambda: bodies.forces(arm, q, v, 0.0, arm.params | {"kp": z(1)}), r'params\["kp"\] must be'),
        (lambda: bodies.forces(arm, q, v, 0.0, arm.params | {"torques": v}), 'did you mean "torque"'),
        (
            lambda: bodies.forces(arm, q, v, 0.0, arm.params | {"wrench": {"fore": z(3)}}),
            r'\["fore"\] must be an array',
        ),
        (lambda: bodies.forces(arm, q, v, z=z(1)), "z must be None"),
        (lambda: bodies.inverse_dynamics(arm, q, v, 1.0), "w must be an array"),
        (lambda: bodies.frames(floating, z(3)), "q must be a dict with 'free'"),
        (lambda: bodies.mass_matrix(arm, q, arm.params | {"timeconst": z(2)}), "no motor of the mechanism is a filter"),
    ]
    for call, words in wrong:
        with pytest.raises(ValueError, match=words):
            call()
    with pytest.raises(TypeError, match="`robot` must be a Mechanism"):
        bodies.mass_matrix(arm.system, q)
    others = arm.params | {"stiffness of a hose": 3.0}  # of a force of the user's own
    assert bodies.forces(arm, q, v, 0.0, others).shape == (2,)
