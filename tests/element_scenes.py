"""Systems of elements for tests, and runs of them with the sparse solve and with a dense one."""

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from hhtjax import Elements, Joints, System, rotation

LIGHT = {"linearize": "predictor"}  # half the program of "auto"
PARAMS = {"k": 200.0, "c": 0.5, "g": 9.81}


def by_lapack(A, b):
    return jnp.linalg.solve(A, b)


def spring(q, v, t, params):
    """A spring and a damper between two points, as soon stiff as not."""
    d = q[1] - q[0]
    length = jnp.sqrt(d @ d)
    along = d / length
    pull = (params["k"] * (length - 0.9) + params["c"] * (along @ (v[1] - v[0]))) * along
    return jnp.stack([pull, -pull])


def weight(q, v, t, params):
    return jnp.zeros_like(v).at[0, 1].set(-params["g"])


def bar(q, w, params):
    """M w of a bar of linear shape functions, whose mass grows with its length."""
    d = q[1] - q[0]
    return jnp.sqrt(d @ d) / 6 * jnp.stack([2 * w[0] + w[1], w[0] + 2 * w[1]])


def rod(q, t, params):
    """Of length 1."""
    d = q[1] - q[0]
    return (d @ d)[None] - 1.0


def shaken(t, params):
    return jnp.stack([0.1 * jnp.sin(5.0 * t), 0.0 * t])


def line(n):
    i = np.arange(n)
    return np.stack([i[:-1], i[1:]], axis=1)


def net(pairs, places, *more, mass=1.0, held=None):
    """Points on springs: the system, and a start at rest."""
    places = jnp.asarray(places, float)
    nodes = np.arange(len(places))[:, None]
    system = System.from_elements(Elements(spring, pairs), Elements(weight, nodes), *more, mass=mass, held=held)
    return system, places, 0 * places


def chain(n=9, **options):
    """Points in line, the first of which stays."""
    i = np.arange(n)
    return net(line(n), np.stack([i, 0.1 * np.sin(i)], axis=1), **({"held": {0: True}} | options))


def driven(n=9, **options):
    system, q0, v0 = chain(n, held={0: shaken}, **options)
    return system, q0, v0.at[0, 0].set(0.5)


def ring(n=10):
    i = np.arange(n)
    around = 2 * np.pi * i / n
    places = 0.5 * np.stack([np.cos(around), np.sin(around)], axis=1) / np.sin(np.pi / n)
    return net(np.stack([i, (i + 1) % n], axis=1), places)


def hub(n=30):
    """Spokes from one point, for which neither gathers nor blocks are enough."""
    i = np.arange(1.0, n)
    places = np.concatenate([np.zeros((1, 2)), np.stack([np.cos(i), np.sin(i)], axis=1)])
    return net(np.array([[0, j] for j in range(1, n)]), places)


def parts():
    """Two chains and a point that nothing holds."""
    i = np.arange(12)
    return net([[0, 1], [1, 2], [2, 3], [5, 6], [6, 7], [7, 8], [8, 9]], np.stack([i, 0.1 * np.sin(i)], axis=1))


def lattice(n=8, joints=True):
    """A square of n n points, its rows in pairs on rods: for SuperLU."""
    i = np.arange(n * n).reshape(n, n)
    pairs = np.concatenate(
        [np.stack([a.ravel(), b.ravel()], axis=1) for a, b in ((i[:-1], i[1:]), (i[:, :-1], i[:, 1:]))]
    )
    places = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2)
    rods = Joints(rod, np.stack([i[:, 0:-1:2].ravel(), i[:, 1::2].ravel()], axis=1))
    return net(pairs, places, *([rods] if joints else []), held={0: True})


def end_of(q, i, side):
    """Of a planar link of length 1."""
    return q["r"][i] + side * 0.5 * jnp.stack([jnp.cos(q["angle"][i]), jnp.sin(q["angle"][i])])


def pin(q, t, params):
    return end_of(q, 0, 1.0) - end_of(q, 1, -1.0)


def ground(q, t, params):
    return end_of(q, 0, -1.0)


def link_weight(q, v, t, params):
    return {"r": jnp.stack([0 * params["g"], -params["g"]])[None]}


def links(n=5, *more, grounded=True, held=None):
    """Rigid links in a chain, horizontal at first."""
    joints = [Joints(ground, [[0]])] if grounded else []
    system = System.from_elements(
        Elements(link_weight, np.arange(n)[:, None]), *joints, Joints(pin, line(n)), *more,
        mass={"r": 1.0, "angle": 1 / 12}, held=held,
    )  # fmt: skip
    q0 = {"r": jnp.stack([jnp.arange(1.0 * n) + 0.5, jnp.zeros(n)], axis=1), "angle": jnp.zeros(n)}
    return system, q0, jax.tree.map(jnp.zeros_like, q0)


def twist(q, v, t, params):
    """A torsional spring between two bodies."""
    R = q["R"][0].T @ q["R"][1]
    moment = params["c"] * rotation.log(R)
    return {"R": jnp.stack([moment, -(R.T @ moment)])}


def gyroscopic(q, v, t, params):
    J = jnp.array([0.02, 0.05, 0.06])
    return {"R": -rotation.cross(v["R"][0], J * v["R"][0])[None]}


def spun(t, params):
    """The first of the bodies."""
    return {"R": rotation.exp(jnp.stack([0.5 * t, 0 * t, 0.3 * t**2]))}


def bodies(n=6):
    """Rotating bodies in a chain of torsional springs, the first of them driven."""
    system = System.from_elements(
        Elements(twist, line(n)), Elements(gyroscopic, np.arange(n)[:, None]),
        mass={"R": np.tile([0.02, 0.05, 0.06], (n, 1))}, held={0: spun},
    )  # fmt: skip
    rates = jnp.asarray(np.random.default_rng(0).normal(size=(n, 3))).at[0].set(jnp.array([0.5, 0.0, 0.0]))
    return system, {"R": jnp.tile(jnp.eye(3), (n, 1, 1))}, {"R": rates}


def run(scene, params=None, dt=0.01, num_steps=10, solve=None, **options):
    system, q0, v0 = scene
    stepper = hhtjax.hht(**LIGHT, solve=solve) if not options else hhtjax.hht(**options, solve=solve)
    return hhtjax.simulate(system, stepper, q0, v0, PARAMS | (params or {}), dt=dt, num_steps=num_steps)


def motion(found):
    return found.q, found.v, found.acceleration, found.multipliers


def distance(one, other):
    """The largest difference of two pytrees."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return max(float(np.max(np.abs(np.asarray(x) - np.asarray(y)))) for x, y in pairs)
