"""Systems: what moves, and where it starts.

    M(q) w = Q(q, v, t) + B^T L,    Phi(q, t) = 0,    B = dPhi/dq

A system is two functions of position q, velocity v, time and parameters, or three with a constraint: M is the mass
matrix, Q the force, w the acceleration; Phi are the constraints, and the multipliers L the forces that hold them. q and
v are any pytrees, that is, nested dicts, lists and tuples of arrays, of one structure; the rows of M follow
`jax.flatten_util.ravel_pytree(v)`, which takes the keys of a dict in sorted order. Whatever may change belongs into
params: it can then be fitted, differentiated, and run in batches.

>>> import jax, jax.numpy as jnp, hhtjax
>>> def mass(q, params):                  # (n, n), or (n,) for a diagonal; or an array in place of the function
...     return jnp.array([params["m"] * params["l"] ** 2])
>>> def force(q, v, t, params):                                                                # structured like v
...     return -params["m"] * 9.81 * params["l"] * jnp.sin(q) - params["k"] * q - params["c"] * v
>>> pendulum = hhtjax.System(mass, force)
>>> params = {"m": 1.0, "l": 0.5, "k": 2.0, "c": 0.05}
>>> q0, v0 = jnp.array([1.0]), jnp.array([0.0])
>>> run = hhtjax.simulate(pendulum, hhtjax.hht(alpha=-0.05), q0, v0, params, dt=1e-2, num_steps=500)
>>> run.check()
>>> run.t.shape, run.q.shape, run.acceleration.shape
((501,), (501, 1), (501, 1))

Functions are known by their identity: a system that reads a global variable keeps the value that it had at the first
call. `hhtjax.runs` says more about it, and the way round.

Energies
--------

Energies are enough: `System.from_lagrangian` makes M and Q of L = T - V by automatic differentiation. A linear system,
`LinearSystem`, is factorised once for a whole run. A first-order system y' = f(y, t) is a `FirstOrderSystem`.

>>> spring = hhtjax.System.from_lagrangian(
...     lagrangian=lambda q, v, t, p: 0.5 * jnp.sum(v**2) - 0.5 * p["k"] * jnp.sum(q**2),
...     force=lambda q, v, t, p: p["u"](t) - 0.1 * v)

M may change in time, as that of a load which is hoisted, or of a pendulum whose length is driven: L may depend on t as
it likes, and `System` takes a function `mass(q, t, params)`. All steppers keep their order on it.

Linear systems, and others with few nonlinear forces
----------------------------------------------------

`LinearSystem(M, C, K, force)` is factorised once for the whole run, also with a nonlinear force at a few coordinates
beside it, an end stop, a joint, a damper, or with dry friction. Matrices may be SciPy's sparse ones, as
`scipy.io.mmread` reads them, and large ones stay sparse (`hhtjax.sparse`); `hhtjax.analysis.modal_reduction` reduces
large ones to their lowest modes, and knows their frequencies.

>>> n = 100
>>> K = 1e4 * (2 * jnp.eye(n) - jnp.eye(n, k=1) - jnp.eye(n, k=-1))
>>> def stop(q, v, t, p):                                                             # of the coordinates `at` alone
...     return -p["stop"] * jnp.maximum(q - 0.01, 0.0)
>>> bar = hhtjax.LinearSystem(jnp.ones(n), 1e-3 * K, K, nonlinear=stop, at=[n - 1])
>>> run = hhtjax.simulate(bar, hhtjax.hht(), jnp.zeros(n), jnp.ones(n), {"stop": 1e5}, dt=1e-3, num_steps=200)
>>> reduced = hhtjax.analysis.modal_reduction(bar, 20)              # reduced.system, .project(q0), .expand(run.q)
>>> [round(float(w), 2) for w in reduced.frequencies[:3]]
[3.11, 6.22, 9.33]

Other packages
--------------

`hhtjax.interop.diffrax_term` is a system as a diffrax term, with (q, v), or (q, v, z), for its state, and
`hhtjax.interop.scipy_rhs` what SciPy's `solve_ivp` takes, Jacobian included; constraints are reduced to index 1. params
may hold modules of equinox, a force that is a neural network among them: `simulate`, `sweep` and `fit` take them as
they are, and `equinox.filter_grad` gives derivatives.

Inputs
------

A measured input is data: `sampled` makes a function of time of it, to be put into params, of samples at equal steps or
at any `times`. `band_limited` does so for
samples hardly denser than their highest frequency, and `spline_gain_error` tells when that is needed.

>>> u = hhtjax.sampled(jnp.sin(jnp.linspace(0.0, 6.0, 61)), dt=0.1)                # a cubic spline through the samples
>>> run = hhtjax.simulate(spring, hhtjax.hht(), q0, v0, {"k": 9.0, "u": u}, dt=1e-2, num_steps=600)
>>> run.check()

Constraints
-----------

`System(mass, force, constraint)` with `constraint(q, t, params) -> (m,)` is a mechanism in more coordinates than it has
freedoms. The `hht` family solves it, by default with one linear solve per step, and with both Phi = 0 and dPhi/dt = 0
enforced, the second by one more multiplier for each constraint (in the formulation of Gear, Gupta and Leimkuhler, GGL
for short). The multipliers come with the solution, and derivatives pass through, those by lengths in the constraint
included. `consistent_initial` moves a start onto the constraint.

>>> rod = hhtjax.System(
...     mass=lambda q, params: params["m"] * jnp.ones(2),
...     force=lambda q, v, t, params: jnp.array([0.0, -9.81 * params["m"]]),
...     constraint=lambda q, t, params: jnp.array([jnp.sqrt(jnp.sum(q**2)) - params["l"]]))
>>> params = {"m": 2.0, "l": 0.5}
>>> start = hhtjax.consistent_initial(rod, jnp.array([0.3, -0.4]), jnp.array([1.0, 0.0]), params)
>>> run = hhtjax.simulate(rod, hhtjax.hht(alpha=-0.1), start.q, start.v, params, dt=1e-3, num_steps=1000)
>>> run.multipliers.shape, float(run.info.constraint.max()) < 1e-10      # minus the tension; how far the length drifts
((1001, 1), True)

Constraints that depend on each other, always or in a singular position, are named with an error;
`hht(redundant="least_squares")` solves them all the same, with the smallest multipliers.

Contact
-------

`System(..., contact=Contact(gap, sliding, friction, restitution))`: bodies in a plane that land on each other, rest,
stick, slide and let go, at up to four places. `gap(q, t, params)` gives the distances and `sliding(q, v, t, params)`
the velocities along the surfaces; friction is Coulomb's, and restitution the part of the normal impulse that returns.
Nothing is made smooth or soft: a body at rest does not creep, and a closed gap is closed to rounding.

    M(q) w = Q + B^T L + J^T (f_N, f_T),    f_N >= 0,    f_N g = 0,    |f_T| <= mu f_N

A ball that bounces to rest, and from when on it rests: sqrt(2 H/g) (1 + e)/(1 - e), with all its infinitely many
bounces, of which those shorter than a step are left out:

>>> floor = hhtjax.Contact(gap=lambda q, t, params: q[0], restitution="e")
>>> ball = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: 0 * q - 9.81, contact=floor)
>>> run = hhtjax.simulate(ball, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), {"e": 0.5}, dt=1e-2, num_steps=200)
>>> run.check()
>>> float(run.contact.normal[-1, 0]), round(float(run.contact.rests_since[-1, 0]), 3)               # 3 sqrt(2/9.81)
(9.81, 1.355)

The `hht` family solves it, in steps of any sizes, with M(q), constraints, rotations that keep the contact in its plane,
internal states, inputs, `sweep` and `fit`. It is of order 2 in q, v and the forces through all impacts and switches,
and derivatives are those of the run. Not in it: more than four contacts, sliding in two directions, restitution where a
body meets one that rests on others. MuJoCo is made for these. Figures beside other ways are on a page,
`experiments/contact/README.md`.

A stiff spring in the place of contact needs far shorter steps, and makes energy where they are too long, without a sign
of it: `hhtjax.analysis.energy_balance(system, run).check()` tells.

Internal states
---------------

Hysteresis, the bristles of friction, the current of a motor, the integral of a controller, a Maxwell branch: what has a
rate, and no position, is a z behind q and v, any pytree, zdot = g(q, v, z, t). It is solved along with the motion, in
the same factorisation and to the same order, however fast it is, by the `hht` family, Rosenbrock methods and (unless it
is fast) Runge-Kutta methods, with constraints, rotations, sweeps and gradients. Forces take z too.

>>> def torque(q, v, z, t, params):
...     return params["kt"] * z["current"] - 0.01 * v
>>> def rate(q, v, z, t, params):                                                                      # L di/dt = ...
...     return {"current": (2.0 - z["current"] - params["kt"] * v) / params["L"]}
>>> arm = hhtjax.System(jnp.array([0.1]), torque, internal=rate)
>>> zero = jnp.zeros(1)
>>> run = hhtjax.simulate(
...     arm, hhtjax.hht(), zero, zero, {"kt": 0.5, "L": 1e-4}, z0={"current": zero}, dt=1e-2, num_steps=500)
>>> run.check()
>>> run.z["current"].shape, run.zdot["current"].shape
((501, 1), (501, 1))
>>> hhtjax.interpolate(run, jnp.array([0.123])).z["current"].shape
(1, 1)

`hhtjax.scenes` has motors, Bouc-Wen hysteresis, LuGre friction and a rubber mount. Relays, whose g jumps, are none of
these, nor is dry friction without bristles.

Coordinates without mass
------------------------

A node between two springs, or between a spring and a damper, has no mass, and so no acceleration that forces give: a
singular mass is an error. Where forces on it depend on positions alone, their balance is a `constraint`, and M may be
singular. It has no reaction: the multiplier is 0. Where a damper sits at it, the balance is its velocity, and the node
an internal state. Here a mass on two springs of 300 and 600 N/m in a row, which are one of 200 N/m; and on a spring of
300 N/m in a row with a damper of 50 N s/m.

>>> def springs(q, v, t, params):
...     node, end = q
...     return jnp.stack([600 * (end - node) - 300 * node, -600 * (end - node)])
>>> row = hhtjax.System(jnp.array([0.0, 2.0]), springs, lambda q, t, params: springs(q, q, t, params)[:1])
>>> run = hhtjax.simulate(row, hhtjax.hht(), jnp.array([0.2, 0.3]), jnp.zeros(2), dt=1e-3, num_steps=314)
>>> run.check()
>>> round(float(run.q[-1, 1]), 3)                                                  # half a period of sqrt(200/2) rad/s
-0.3
>>> damped = hhtjax.System(
...     jnp.ones(1), lambda end, v, node, t, params: -300 * (end - node),
...     internal=lambda end, v, node, t, params: 300 * (end - node) / 50)

Dry friction
------------

Coulomb's law says what friction is while a joint slides, and only a bound while it sticks:

    M(q) w = Q + B^T L - H^T tau,    tau = F sign(s) where s != 0,    |tau| <= F where s = 0

`System(..., friction=limit)` has the limits F(q, v, t), one for each coordinate, 0 where nothing rubs; with `sliding`,
s(q, v, t), one for each of its rows, up to 8. F may fall with speed from a stiction (Stribeck), and depend on position,
time, internal states, and the multipliers of constraints, that is, on normal loads. Nothing is made smooth: what sticks
does not creep. The `hht` family solves it with one factorisation per step and is of order 2 in q, v and z through every
switch, with M(q), constraints, rotations and internal states; derivatives converge to those of the exact motion, so
limits can be fitted. The best step is still short beside the time a joint slides or sticks: the second of two switches
of a single joint in one step waits for the next. Several joints, coupled by their inertia or not, are followed from
switch to switch within the step, as the switch of one jerks the others.

>>> def force(q, v, t, params):
...     return -params["k"] * q + 6.0 * jnp.sin(2.0 * t)
>>> def limit(q, v, t, params):                                                               # Coulomb's, and stiction
...     return params["F"] * (1 + 0.3 * jnp.exp(-jnp.abs(v) / 0.05))
>>> block = hhtjax.System(jnp.ones(1), force, friction=limit)
>>> params = {"k": 20.0, "F": 3.0}
>>> run = hhtjax.simulate(block, hhtjax.hht(), jnp.zeros(1), jnp.zeros(1), params, dt=1e-2, num_steps=800)
>>> run.check()
>>> run.friction.shape, round(float(run.sticking.mean()), 2)                       # tau; part of the time it sticks
((801, 1), 0.32)

What rolls, or glides on a knife edge, is held in its velocities, for which `constraint` has no place: it is a joint
that never slides, with those velocities as `sliding`, and a limit beyond all forces; tau are then the forces that hold
it. It has to start without sliding.

On a belt with the speed u, `sliding=lambda q, v, t, params: v - params["u"]`; between two bodies it is the difference
of their velocities. s must be affine in v. Its rows, up to 16, may depend on each other and on constraints: all joints
of a closed loop rub, and those of a mechanism whose crank is driven. The motion is unique, the forces at joints that
stick are not; `System` says which are given. A limit in a
system with internal states is called as limit(q, v, z, t, params), with a constraint as limit(q, v, L, t, params). F is
to be continuous: a jump from stiction to sliding is written as a steep Stribeck curve. Between saved times
`interpolate` is of order 2 only where a joint switches. `energy_balance` knows what friction takes, and what a belt
gives.

Many unknowns
-------------

A beam, a cable, a frame or a net is many small parts, each a function of its own few nodes. `System.from_elements` adds
them up, and from where they are follows how a step is solved: its cost grows with the number of nodes, not with its
cube. `hhtjax.elements` has beams, cables, springs and joints, but any function will do. A cantilever of 100 elements
that is bent to a circle by the moment at its tip, 2 pi EI/L, slowly and with damping:

>>> import numpy as np
>>> from hhtjax import Elements, elements
>>> pairs = np.stack([np.arange(100), np.arange(1, 101)], axis=1)
>>> section = {"L": 0.01, "EA": 1e4, "GA": 5e3, "EI": 1.0, "damping": 0.1}
>>> def turned(q, v, t, params):
...     return {"theta": 2 * jnp.pi * jnp.minimum(t / 5, 1)[None]}
>>> cantilever = hhtjax.System.from_elements(
...     Elements(elements.planar_beam, pairs, each=section), Elements(turned, [[100]]),
...     mass={"r": 0.01, "theta": 1e-4}, held={0: True})
>>> x = jnp.linspace(0, 1, 101)
>>> q0 = {"r": jnp.stack([x, 0 * x], axis=1), "theta": 0 * x}
>>> v0 = {"r": jnp.zeros((101, 2)), "theta": 0 * x}
>>> run = hhtjax.simulate(cantilever, hhtjax.hht(), q0, v0, dt=0.02, num_steps=500, save_every=500)
>>> run.check()
>>> round(float(run.q["theta"][-1, -1] / jnp.pi), 2), bool(jnp.max(jnp.abs(run.q["r"][-1, -1])) < 0.01)
(2.0, True)

A system that is one function, with thousands of unknowns of which each meets a few, takes `hht(solve=sparse_lu())`,
which reads from the functions which ones: with constraints, internal states and rotations, too.

Rotations
---------

A leaf R (3, 3) of q, or several as (k, 3, 3), whose leaf of v has shape (3,) or (k, 3), is a rotation from material
(body-fixed) to spatial components, and that leaf its material angular velocity, Rdot = R hat(Om). The `hht` family
turns it by rotation vectors (`kinematics="chart"`) or directly (`"lie"`), both of second order for any inertia, and
keeps it orthogonal to rounding. `hhtjax.rotation` has the exponential, the logarithm, the tangent maps and their
derivatives, right at zero too.

>>> def gyroscopic(R, Om, t, params):
...     return -jnp.cross(Om, params["J"] * Om)
>>> body = hhtjax.System(mass=lambda R, params: params["J"], force=gyroscopic)
>>> spin = jnp.array([0.01, 5.0, 0.01])                                  # about the axis of middle inertia: it tumbles
>>> inertia = {"J": jnp.array([1.0, 2.0, 3.0])}
>>> run = hhtjax.simulate(body, hhtjax.hht(), jnp.eye(3), spin, inertia, dt=1e-2, num_steps=400)
>>> run.q.shape, hhtjax.rotation.log(run.q[-1]).shape
((401, 3, 3), (3,))

What became of the figures of Cardona and Geradin, and what a non-iterative step does to them, is on a page of its own,
`experiments/cardona_geradin1989/README.md`.
"""
