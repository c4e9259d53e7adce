"""Runs: one run, many runs at once, runs saved to disk, values between samples; and their failures.

    simulate          one run: a `Solution`, whose `check()` names the first step that failed
    sweep             many runs at once, each with its own step size, parameters, start and coefficients
    sweep_to_disk     a sweep in chunks, by this process or by workers; it can be killed and continued
    parallel_map      any function of many members, by the workers of an executor; `map_to_disk` saves the results
    adaptive          tolerances instead of a step size; `choose_steps` returns the steps alone
    Event, impact     changes when a guard falls to zero: impacts, stops, switches, the end of the run
    interpolate       values between the saved times

Everything composes with `jit`, `vmap` and `grad`: dt, alpha, q0, v0 and params can all be differentiated.

>>> import jax, jax.numpy as jnp, hhtjax
>>> pendulum = hhtjax.System(lambda q, params: jnp.array([params["l"]]), lambda q, v, t, params: -9.81 * jnp.sin(q))
>>> q0, v0, params = jnp.array([1.0]), jnp.array([0.0]), {"l": 0.5}
>>> def final_angle(dt, alpha, length):
...     stepper = hhtjax.hht(alpha=alpha)
...     return hhtjax.simulate(pendulum, stepper, q0, v0, {"l": length}, dt=dt, num_steps=30).q[-1, 0]
>>> [bool(jnp.isfinite(x)) for x in jax.grad(final_angle, argnums=(0, 1, 2))(1e-2, -0.05, 0.5)]
[True, True, True]
>>> jax.vmap(final_angle, in_axes=(0, None, None))(jnp.logspace(-4, -1, 7), -0.05, 0.5).shape     # many steps at once
(7,)

When a program is compiled anew
-------------------------------

A system, or the residuals of a fit, is compiled at the first call. Later calls reuse the program if the functions, and
everything that they read from outside, are the same: globals, closure variables, lists, objects, arrays. If any of
these has changed, the next call compiles anew:

>>> stiffness = 1.0
>>> def force(q, v, t, params):
...     return -stiffness * q
>>> spring = hhtjax.System(jnp.ones(1), force)
>>> def end():
...     return float(hhtjax.simulate(spring, hhtjax.hht(), q0, v0, dt=1e-2, num_steps=10).q[-1, 0])
>>> before = end()
>>> stiffness = 100.0
>>> end() < before
True

So put what changes often into params: this costs no compilation, and has derivatives. `fit` says what it does with
data, and `simulate` what happens inside your own jit.

The first call
--------------

The first call takes seconds, because the functions are traced and XLA compiles the result. Inside your own `jax.jit`
compilation can take twice as long. Pass the options that the library uses itself,
`jax.jit(f, compiler_options=hhtjax.xla.QUICK)`, for systems of up to 32 unknowns on the CPU. Compiled programs can be
kept on disk. A second process then only has to trace, which takes a quarter to two thirds of the time. Before the first
call:

    hhtjax.keep_programs("~/.cache/hhtjax")

A first call that takes longer than two seconds writes one line to stderr, by the logger `hhtjax` of Python's `logging`.
`logging.getLogger("hhtjax").setLevel("ERROR")` silences it.

After the imports, call `import gc; gc.freeze()` to save 5 to 20 % of a first call: the garbage collector then does not
inspect all imported objects again and again during tracing. The library does not change the collector.

Later calls
-----------

A later call of `simulate` takes some 0.2 ms of Python, to check its arguments and what its functions read. In your own
jit this time disappears. If only q is returned, a run of fifty steps then takes a tenth longer than a plain loop over
its steps; each further array of the `Solution` takes about a microsecond. Arrays in params are passed faster than
Python numbers, and several arrays faster than one vector that is split inside. JAX passes programs of more than a
thousand operations to another thread, which takes 10 us; `jax.config.update("jax_cpu_enable_async_dispatch", False)`,
before anything else, avoids this. The page `experiments/benchmarks/README.md` has the measurements.

A controller that samples
-------------------------

A sampling controller reads the state at the start of each period and holds its force during the period. Write it as a
scan over short runs, one for each period. Each run starts from the end of the previous one, with the force in params.
The memory of the controller (an integral, or the last force to limit its rate) goes into the carry. This controller
brings a mass to rest at zero in two periods:

>>> def controlled(params, period=0.1):
...     def run_for_a_period(carry, t0):
...         q, v = carry
...         held = params | {"u": -q / period**2 - 1.5 * v / period}
...         run = hhtjax.simulate(cart, hhtjax.hht(), q, v, held, t0=t0, dt=period / 5, num_steps=5)
...         return (run.q[-1], run.v[-1]), run
...     return jax.lax.scan(run_for_a_period, (jnp.ones(1), jnp.zeros(1)), period * jnp.arange(4.0))[1]
>>> cart = hhtjax.System(jnp.ones(1), lambda q, v, t, params: params["u"] - params["c"] * v)
>>> runs = jax.jit(controlled)({"c": 0.0})                               # without jit each call traces it again
>>> runs.check()                                                         # in a message, members are the periods
>>> runs.q.shape, [round(abs(float(q)), 6) for q in runs.q[:, -1, 0]]    # start and steps of each; its end
((4, 6, 1), [0.5, 0.0, 0.0, 0.0])

Each run starts anew where the force jumps, so the method keeps its order. Derivatives pass through all runs, and each
run is one kernel. 1500 periods of a crane with five steps each take half the time of plain JAX if only their ends are
saved (`save_every=5`), and 0.7 of it if all steps are. The matrices of a `LinearSystem` are factorised once, before the
scan. Each start takes some 12 additional solves; `hht(start="simple")` avoids them if nothing is stiff. Continue
internal states from `run.z[-1]`. For a held input that is known in advance use `sampled(order=0)`.

Sweeps
------

Step sizes, parameters, initial states and coefficients are data. One compiled call runs any list of step sizes, and
samples all runs at the same times. Its work is about the sum of the steps of its members. A member that fails is
flagged and does not affect the others.

>>> dts = jnp.logspace(-3, -1, 9)                    # made smaller, if need be, to land on the samples: sweep.dt
>>> sweep = hhtjax.sweep(pendulum, hhtjax.hht(), q0, v0, params, dts=dts, duration=2.0, num_samples=20)
>>> sweep.check()
>>> sweep.q.shape
(9, 21, 1)

`times=` replaces `duration` and `num_samples` by sample times at any distances, such as those of measured data; steps
end at each of them. `in_axes=`, as for `jax.vmap`, says what else differs between members. `sweep_to_disk` writes
chunks of members as `.npz` files or as one Zarr store. It continues after it was killed, and raises an error if the
inputs have changed. With `executor=` the workers of a cluster run the chunks, however they were started. `parallel_map`
lets them run your own functions in the same way.

>>> from concurrent.futures import ThreadPoolExecutor                 # or Dask's client.get_executor(), MPIPoolExecutor
>>> with ThreadPoolExecutor(2) as executor:
...     ends = hhtjax.parallel_map(lambda dt: final_angle(dt, 0.0, 0.5), dts, chunk=3, executor=executor)
>>> ends.shape
(9,)

If all devices are available from the start, run this in every process:

    jax.distributed.initialize()
    mesh = jax.make_mesh((jax.device_count(),), ("members",))
    sweep = hhtjax.sweep(pendulum, hhtjax.hht(), q0, v0, params, dts=dts, duration=2.0, num_samples=20, mesh=mesh)

The results agree with those of one device to rounding: each device gets its own blocks of members, which XLA may
compile differently. The page `experiments/sweeps/README.md` has the run times of such sweeps, and of large systems with
`hht(solve=hhtjax.banded(p))` or `conjugate_gradients(k)`, whose step time is proportional to the number of unknowns. It
also has those of single steps called at 1 kHz.

Dense output
------------

`interpolate` returns q, v and internal states at any times inside a run. It is differentiable, so a fit can compare
with measurements at their own times.

>>> run = hhtjax.simulate(pendulum, hhtjax.hht(), q0, v0, params, dt=1e-2, num_steps=600)
>>> hhtjax.interpolate(run, jnp.array([0.123, 4.56])).q.shape
(2, 1)

It returns accelerations, multipliers and dry friction, too. `simulate(..., times=)` interpolates at such times during
the run, and keeps nothing else.

Outputs
-------

With `output=`, `simulate`, `sweep` and `sweep_to_disk` save a function of the motion instead of q and v: sensor
signals, energies, a distance. The function receives the quantities that its arguments name: q, v, w (the acceleration),
L (multipliers), z, zdot, friction, sticking, contact, t and params. A run of a million steps of a large system then
keeps only what you ask for.

>>> def felt(q, w, params):
...     return {"height": -params["l"] * jnp.cos(q[0]), "turning": w[0]}
>>> run = hhtjax.simulate(pendulum, hhtjax.hht(), q0, v0, params, dt=1e-2, times=[0.123, 4.56], output=felt)
>>> run.check()
>>> run.q, run.output["height"].shape
(None, (3,))

`hhtjax.measure` applies such an output to a run that has saved q and v, as a sensor with its own delay, offset and
clock. `hhtjax.accelerometer` is such an output.

Tolerances
----------

`dt=adaptive(rtol, atol)` chooses steps by their errors, in one loop that also keeps the samples. For derivatives, and
in a batch, a second run with these steps follows, which is differentiable and treats the steps as constants.
`run.steps` holds the numbers of accepted and rejected steps. `check()` names the time at which steps ended too early.
Use it for motions with phases of very different speed, such as contacts and relaxation. For conservative motions with
one time scale prefer equal steps, whose errors cancel over a period.

>>> run = hhtjax.simulate(pendulum, hhtjax.hht(), q0, v0, params, dt=hhtjax.adaptive(1e-3, 1e-6), times=[0.123, 4.56])
>>> run.check()
>>> run.q.shape
(3, 1)

An error estimate for one step does not show how the motion amplifies the error later. `verify=True` reports the error
of the whole run, `run.error`, at each sample, and `check()` fails above ten times the tolerance. `verify="tighten"`
chooses steps again, for smaller tolerances, until the error of the run is below the tolerance. Without it the error in
this example is 20 times the tolerance.

>>> planet = hhtjax.System(jnp.ones(2), lambda q, v, t, p: -q / jnp.sum(q**2) ** 1.5)
>>> start, year = (jnp.array([0.5, 0.0]), jnp.array([0.0, 3**0.5])), jnp.linspace(0, 2 * jnp.pi, 13)[1:]
>>> for verify in (False, "tighten"):
...     control = hhtjax.adaptive(1e-3, 1e-6, verify=verify)
...     run = hhtjax.simulate(planet, hhtjax.hht(), *start, dt=control, times=year)
...     print(round(float(jnp.max(jnp.abs(run.q[-1] - start[0])) / (1e-3 * jnp.max(jnp.abs(run.q)) + 1e-6)), 2))
19.63
0.76

In a sweep each member has its own steps, and tolerances may be data, so error against tolerance is one call.

>>> rtol = jnp.array([1e-2, 1e-3, 1e-4])
>>> sweep = hhtjax.sweep(
...     pendulum, hhtjax.hht(), q0, v0, params, dts=hhtjax.adaptive(rtol, 1e-3 * rtol), times=[0.123, 4.56])
>>> sweep.q.shape, bool(jnp.all(jnp.diff(sweep.steps.accepted) > 0))
((3, 3, 1), True)

Events
------

`events=[Event(guard, reset=, switch=, terminal=)]` describes impacts, end stops, backlash, switches and the end of the
run. When a guard falls to zero inside a step, the step is taken up to that time, the velocity or the params change, and
the rest of the step follows. The time grid and the saved times do not change, and the method keeps its order.
Derivatives are exact, including that of the event time. `run.events` holds which events happened, when, and the
velocities before and after.

>>> ball = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, p: 0 * q - 9.81)
>>> floor = hhtjax.Event(guard=lambda q, v, t, p: q[0] - p["floor"], reset=hhtjax.impact(restitution="e"))
>>> def bounce(e):
...     params = {"e": e, "floor": 0.0}
...     return hhtjax.simulate(
...         ball, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), params, dt=2e-2, num_steps=30, events=[floor])
>>> run = bounce(0.8)
>>> run.check()
>>> [round(float(v[0, 0]), 4) for v in (run.events.before, run.events.after)]
[-4.4294, 3.5436]
>>> round(float(jax.grad(lambda e: bounce(e).q[-1, 0])(0.8)), 4)              # 4.4294 (0.6 - sqrt(2/9.81))
0.6577

A force that jumps is written with a mode, a number in params that `switch` changes: a stop with a damper, a clutch, a
broken link. Here a spring acts only beyond q = 1:

>>> stop = hhtjax.Event(
...     guard=lambda q, v, t, p: (1.0 - q[0]) * (1 - 2 * p["on"]), switch=lambda p: p | {"on": 1 - p["on"]})
>>> wagon = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, p: -p["on"] * (100 * (q - 1.0) + 2 * v))
>>> run = hhtjax.simulate(
...     wagon, hhtjax.hht(), jnp.zeros(1), jnp.ones(1), {"on": 0.0}, dt=1e-2, num_steps=200, events=[stop])
>>> run.check()
>>> int(run.events.count), round(float(run.events.after[1, 0]), 2)
(2, -0.73)

`switch(q, v, t, params)` takes the state, too. For changes at known times use `Event(at=times)`, with numbers or a
function of params, instead of a guard. It divides steps there, and with error control steps end there. Runs are
differentiable in the times.

>>> brake = hhtjax.Event(at=lambda p: p["time"], switch=lambda p: p | {"force": -0.8})
>>> cart = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, p: p["force"] + 0 * q)
>>> def where(time):
...     params = {"time": time, "force": 0.0}
...     run = hhtjax.simulate(
...         cart, hhtjax.hht(), jnp.zeros(1), jnp.ones(1), params, dt=0.1, num_steps=10, events=[brake])
...     return run.q[-1, 0]
>>> [round(float(f(0.27)), 6) for f in (where, jax.grad(where))]              # 1 - .4 (1 - .27)^2, .8 (1 - .27)
[0.78684, 0.584]

For lasting contact use a `Contact` of the system (`hhtjax.systems`). In three dimensions, without friction, use a
constraint that events switch on and off: on where the body reaches its stop, with `impact(0.0)`, and off where the
multiplier falls to zero, by a guard with an argument `multipliers`. The number of constraints of a run is fixed, so a
constraint that is off fixes a separate coordinate instead; see `hhtjax.scenes.shaken_table`. A body may start at rest
at its guard if its acceleration lifts it off.

A run never ends beyond a guard. These failures are reported: more changes in one step than `max_events`, as for a ball
that comes to rest; a guard that stays negative; two impacts at the same time; a start beyond a guard. Derivatives hold
for a fixed order of events. If a motion only grazes a guard they grow without bound (see `run.events.rate`). A guard
that falls below zero and rises again within a step is detected if the cubic through its values and rates at both ends
falls below zero.

Events work with mass matrices, constraints (the impulse obeys them), rotations, internal states, dry friction, held
inputs, uneven steps, `interpolate`, `sweep`, `fit`, `extrapolate` (which then has order 3), and error control. With
error control, samples lie on the motion before or after an event, and steps with more than one event are shortened. In
your own `jax.vmap` they cost what they cost in `sweep`: the batch does the work of an event only in steps in which a
member has one. In `vmap` of a reverse derivative they cost more. The page `experiments/events/README.md` has figures,
orders, derivatives and an impact oscillator.

Extrapolation
-------------

`simulate(..., extrapolate=2)` or 3 combines two or three runs, with steps dt, dt/2 (and dt/4), to remove the leading
errors in dt. Where the motion is smooth and dt resolves it, the order is 3 with two runs and 4 with three. With
switches of dry friction it is 3.
"""
