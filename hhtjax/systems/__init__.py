"""Systems: what moves, and where it starts.

    M(q) w = Q(q, v, t) + B^T L,    Phi(q, t) = 0,    B = dPhi/dq

A system is given by functions of position q, velocity v, time and parameters: M is the mass matrix, Q the force, and
Phi, if there are any, the constraints. w is the acceleration, and the multipliers L are the constraint forces. q and v
are any pytrees (nested dicts, lists and tuples of arrays) of the same structure. The rows of M follow
`jax.flatten_util.ravel_pytree(v)`, which takes the keys of a dict in sorted order. Put whatever may change into params:
it can then be fitted, differentiated, and run in batches.

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

A system whose functions read a global variable is compiled anew when that variable has changed. `hhtjax.runs` says more
about it, and how to avoid it.

Energies
--------

If you know the energies, `System.from_lagrangian` derives M and Q from L = T - V by automatic differentiation. For a
linear system use `LinearSystem`, which is factorised once for a whole run. For a first-order system y' = f(y, t) use
`FirstOrderSystem`.

>>> spring = hhtjax.System.from_lagrangian(
...     lagrangian=lambda q, v, t, p: 0.5 * jnp.sum(v**2) - 0.5 * p["k"] * jnp.sum(q**2),
...     force=lambda q, v, t, p: p["u"](t) - 0.1 * v)

M may change in time, as for a load that is hoisted, or a pendulum whose length is driven. L may depend on t in any way,
and `System` takes a function `mass(q, t, params)`. All steppers keep their order.

Linear systems, and others with few nonlinear forces
----------------------------------------------------

`LinearSystem(M, C, K, force)` is factorised once for the whole run. It may also have a nonlinear force at a few
coordinates (an end stop, a joint, a damper), or dry friction. Matrices may be SciPy's sparse ones, for example from
`scipy.io.mmread`; large ones stay sparse (`hhtjax.sparse`). `hhtjax.analysis.modal_reduction` reduces large systems to
their lowest modes, and returns the frequencies.

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

`hhtjax.interop.diffrax_term` turns a system into a diffrax term with the state (q, v), or (q, v, z).
`hhtjax.interop.scipy_rhs` returns the arguments of SciPy's `solve_ivp`, Jacobian included. Both reduce constraints to
index 1. params may contain modules of equinox, such as a force that is a neural network: `simulate`, `sweep` and `fit`
accept them, and `equinox.filter_grad` gives derivatives.

Inputs
------

`sampled` turns a measured input, with samples at equal steps or at any `times`, into a function of time; put it into
params. If the samples are hardly denser than their highest frequency, use `band_limited`; `spline_gain_error` returns
the error without it.

>>> u = hhtjax.sampled(jnp.sin(jnp.linspace(0.0, 6.0, 61)), dt=0.1)                # a cubic spline through the samples
>>> run = hhtjax.simulate(spring, hhtjax.hht(), q0, v0, {"k": 9.0, "u": u}, dt=1e-2, num_steps=600)
>>> run.check()

Constraints
-----------

`System(mass, force, constraint)` with `constraint(q, t, params) -> (m,)` describes a mechanism with more coordinates
than freedoms. The `hht` family solves it, by default with one linear solve per step. Both Phi = 0 and dPhi/dt = 0 are
enforced, the latter by a second multiplier for each constraint (the formulation of Gear, Gupta and Leimkuhler, GGL).
The solution contains the multipliers. Derivatives work, also with respect to lengths in the constraint.
`consistent_initial` moves a start onto the constraint.

>>> rod = hhtjax.System(
...     mass=lambda q, params: params["m"] * jnp.ones(2),
...     force=lambda q, v, t, params: jnp.array([0.0, -9.81 * params["m"]]),
...     constraint=lambda q, t, params: jnp.array([jnp.sqrt(jnp.sum(q**2)) - params["l"]]))
>>> params = {"m": 2.0, "l": 0.5}
>>> start = hhtjax.consistent_initial(rod, jnp.array([0.3, -0.4]), jnp.array([1.0, 0.0]), params)
>>> run = hhtjax.simulate(rod, hhtjax.hht(alpha=-0.1), start.q, start.v, params, dt=1e-3, num_steps=1000)
>>> run.multipliers.shape, float(run.info.constraint.max()) < 1e-10      # minus the tension; how far the length drifts
((1001, 1), True)

Constraints that depend on each other, always or in a singular position, raise an error that names them.
`hht(redundant="least_squares")` solves them with the smallest multipliers.

Contact
-------

`System(..., contact=Contact(gap, sliding, friction, restitution))` describes bodies in a plane that collide, rest,
stick, slide and separate, at up to four contacts. `gap(q, t, params)` returns the distances, and
`sliding(q, v, t, params)` the velocities along the surfaces. Friction is Coulomb's. Restitution is the ratio of the
normal impulse of expansion to that of compression. Nothing is smoothed or softened: a body at rest does not creep, and
a closed gap is closed to rounding.

    M(q) w = Q + B^T L + J^T (f_N, f_T),    f_N >= 0,    f_N g = 0,    |f_T| <= mu f_N

Example: a ball is dropped from the height H and bounces until it rests, from the time sqrt(2 H/g) (1 + e)/(1 - e) on.
Infinitely many bounces come before this time; those shorter than a step are not computed:

>>> floor = hhtjax.Contact(gap=lambda q, t, params: q[0], restitution="e")
>>> ball = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: 0 * q - 9.81, contact=floor)
>>> run = hhtjax.simulate(ball, hhtjax.hht(), jnp.ones(1), jnp.zeros(1), {"e": 0.5}, dt=1e-2, num_steps=200)
>>> run.check()
>>> float(run.contact.normal[-1, 0]), round(float(run.contact.rests_since[-1, 0]), 3)               # 3 sqrt(2/9.81)
(9.81, 1.355)

The `hht` family supports contact with steps of any sizes, M(q), constraints, rotations that keep the contact in its
plane, internal states, inputs, `sweep` and `fit`. It has order 2 in q, v and the forces through all impacts and
switches. Derivatives are those of the computed run. Not supported: more than four contacts, sliding in two directions,
and restitution where a body collides with one that rests on others. Use MuJoCo for these. The page
`experiments/contact/README.md` compares with other approaches.

A stiff spring instead of contact needs far shorter steps. If they are too long it generates energy without a warning;
`hhtjax.analysis.energy_balance(system, run).check()` detects this.

Internal states
---------------

An internal state z has a rate but no position: zdot = g(q, v, z, t). Examples are hysteresis, the bristles of a
friction model, the current of a motor, the integral of a controller, and a Maxwell branch. z is any pytree and follows
q and v in argument lists. It is solved together with the motion, in the same factorisation and to the same order,
however fast it is. The `hht` family, `extrapolated` and Rosenbrock methods support it; unless z is fast, Runge-Kutta
methods and `taylor` do, too. The `hht` family also combines it with constraints and rotations. Sweeps and gradients
work. Forces take z too.

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

`hhtjax.scenes` has motors, Bouc-Wen hysteresis, LuGre friction and a rubber mount. Relays, whose g jumps, and dry
friction without bristles cannot be internal states; use `Event` or `friction=`.

Coordinates without mass
------------------------

A node between two springs, or between a spring and a damper, has no mass. Its acceleration does not follow from forces,
and a singular mass is an error. If the forces on it depend on positions only, write their balance as a `constraint`; M
may then be singular. Its multiplier is 0, since the balance needs no reaction. If a damper acts on it, the balance
gives its velocity, and the node is an internal state. The first example is a mass on two springs of 300 and 600 N/m in
series, which act like one of 200 N/m. The second is a mass on a spring of 300 N/m in series with a damper of 50 N s/m.

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

Coulomb's law gives the friction force of a sliding joint. For a sticking joint it only gives a bound:

    M(q) w = Q + B^T L - H^T tau,    tau = F sign(s) where s != 0,    |tau| <= F where s = 0

`System(..., friction=limit)` takes the limits F(q, v, t), one for each coordinate, 0 where there is no friction. With
`sliding`, s(q, v, t), it takes one for each row of s. F may fall with speed from a stiction (Stribeck), and may depend
on position, time, internal states, and on the multipliers of constraints, that is, on normal loads. Nothing is
smoothed: a sticking joint does not creep. The `hht` family solves the law with one factorisation per step. It has order
2 in q, v and z through every switch, with M(q), constraints, rotations and internal states. Derivatives converge to
those of the exact motion, so limits can be fitted. Choose a step that is short compared with the times during which a
joint slides or sticks: if a single joint switches twice in one step, the second switch is delayed to the next step.
With several joints, coupled by inertia or not, every switch within a step is computed, because the switch of one joint
makes the acceleration of the others jump.

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

Rolling, or gliding on a knife edge, is a velocity constraint, which `constraint` cannot express. Describe it as a joint
that never slides: take the velocities that must be zero as `sliding`, with a limit larger than all forces. tau are then
the constraint forces. The start must not slide.

On a belt with speed u, use `sliding=lambda q, v, t, params: v - params["u"]`; between two bodies, use the difference of
their velocities. s must be affine in v. It has up to 16 rows, which may depend on each other and on constraints: all
joints of a closed loop may have friction, or those of a mechanism whose crank is driven. The motion is then unique, but
the forces at sticking joints are not; the docstring of `System` says which ones are returned. With internal states the
limit is called as limit(q, v, z, t, params), with a constraint as limit(q, v, L, t, params). F must be continuous:
write a jump from stiction to sliding as a steep Stribeck curve. Between saved times `interpolate` has only order 2
where a joint switches. `energy_balance` accounts for the energy that friction dissipates and that a belt supplies.

Many unknowns
-------------

A beam, a cable, a frame or a net consists of many small parts, each a function of its own few nodes.
`System.from_elements` sums them. Their connections determine how a step is solved: its cost grows with the number of
nodes, not with its cube. `hhtjax.elements` has beams, cables, springs and joints, but any function works. Example: a
cantilever of 100 elements that is bent to a circle by the moment 2 pi EI/L at its tip, slowly and with damping:

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

If a system is a single function of thousands of unknowns, each coupled to a few others, use `hht(solve=sparse_lu())`.
It finds the couplings from the functions. It works with constraints, internal states and rotations, too.

Rotations
---------

A leaf R (3, 3) of q, or several as (k, 3, 3), is a rotation from material (body-fixed) to spatial components. The same
leaf of v, of shape (3,) or (k, 3), is the material angular velocity Om, with Rdot = R hat(Om). The `hht` family
integrates it by rotation vectors (`kinematics="chart"`) or directly (`"lie"`). Both have second order for any inertia,
and keep R orthogonal to rounding. `hhtjax.rotation` has the exponential, the logarithm, the tangent maps and their
derivatives, which are correct at zero too.

>>> def gyroscopic(R, Om, t, params):
...     return -jnp.cross(Om, params["J"] * Om)
>>> body = hhtjax.System(mass=lambda R, params: params["J"], force=gyroscopic)
>>> spin = jnp.array([0.01, 5.0, 0.01])                                  # about the axis of middle inertia: it tumbles
>>> inertia = {"J": jnp.array([1.0, 2.0, 3.0])}
>>> run = hhtjax.simulate(body, hhtjax.hht(), jnp.eye(3), spin, inertia, dt=1e-2, num_steps=400)
>>> run.q.shape, hhtjax.rotation.log(run.q[-1]).shape
((401, 3, 3), (3,))

The page `experiments/cardona_geradin1989/README.md` repeats the figures of Cardona and Geradin, and shows the effect of
a non-iterative step on them.
"""
