"""Runs: one, many at once, over the disk, between their samples; and what they say about themselves.

    simulate          one run: a `Solution`, whose `check()` names the first step that failed
    sweep             many runs at once, with step sizes, parameters, starts and coefficients of their own
    sweep_to_disk     the same in pieces, which survive being killed, by this process or by workers
    parallel_map      any function of many members, by the workers of an executor; `map_to_disk` keeps what is done
    adaptive          a tolerance in the place of the step size; `choose_steps` gives the steps alone
    Event, impact     what happens where a guard falls to zero: impacts, stops, switches, the end
    interpolate       what lies between the saved times

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

Known by what they read
-----------------------

A system, or the residuals of a fit, is compiled at the first call, and then known by its functions and by all that they
read from outside: globals, variables around them, lists, objects, arrays. What has changed is seen in the next call,
which compiles anew:

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

So what changes often belongs into params: that costs no compilation, and has derivatives. `fit` says what it does with
data; `simulate`, what holds inside a jit of yours.

The first call
--------------

takes seconds: the functions are traced, and XLA compiles what becomes of them, where a jit of yours is around it in up
to twice the time that it takes elsewhere, unless that asks for the same: `jax.jit(f,
compiler_options=hhtjax.xla.QUICK)`, for systems of up to 32 unknowns on the CPU. Compiled programs can be kept on disk.
A second process then has only to trace, in a quarter to two thirds of the time. Before the first call:

    hhtjax.keep_programs("~/.cache/hhtjax")

While a first call takes longer than two seconds, one line on stderr says so, by the logger `hhtjax` of Python's
`logging`; `logging.getLogger("hhtjax").setLevel("ERROR")` keeps it quiet.

After the imports, `import gc; gc.freeze()` spares the garbage collector all that they have made, which it else looks
through again and again while functions are traced: 5 to 20 % of a first call. The library leaves the collector alone.

Later calls
-----------

take some 0.2 ms of Python where `simulate` is called as it is: its arguments are checked, and what its functions read
is looked at. In a jit of yours they do not: a run of fifty steps then takes a tenth more than its steps in a loop of
their own where q alone is returned, and each further array of the `Solution` takes about a microsecond. Arrays among
params are handed over faster than numbers of Python, and several faster than one vector that is taken apart inside. JAX
hands programs of more than a thousand operations to another thread, which takes 10 us;
`jax.config.update("jax_cpu_enable_async_dispatch", False)`, before anything else, does without. Measured on a page,
`experiments/benchmarks/README.md`.

A controller that samples
-------------------------

It reads the state every so often, and holds its force in between. That is a scan over short runs, one for each period,
each from the end of the one before, with the force in params. What the controller remembers (an integral, the last
force, for a limit on its rate) goes along in the carry. This one takes a mass to zero, and to rest, in two periods:

>>> def controlled(params, period=0.1):
...     def run_for_a_period(carry, t0):
...         q, v = carry
...         held = params | {"u": -q / period**2 - 1.5 * v / period}
...         run = hhtjax.simulate(cart, hhtjax.hht(), q, v, held, t0=t0, dt=period / 5, num_steps=5)
...         return (run.q[-1], run.v[-1]), run
...     return jax.lax.scan(run_for_a_period, (jnp.ones(1), jnp.zeros(1)), period * jnp.arange(4.0))[1]
>>> cart = hhtjax.System(jnp.ones(1), lambda q, v, t, params: params["u"] - params["c"] * v)
>>> runs = jax.jit(controlled)({"c": 0.0})                               # without jit each call traces it again
>>> runs.check()                                                         # what it calls members are the periods
>>> runs.q.shape, [round(abs(float(q)), 6) for q in runs.q[:, -1, 0]]    # start and steps of each; its end
((4, 6, 1), [0.5, 0.0, 0.0, 0.0])

Each run begins anew, where the force jumps, so that the method keeps its order; derivatives pass through all, and each
is one kernel: 1500 periods of a crane, of five steps each, take half the time of the same on plain JAX, where their
ends alone are kept (`save_every=5`), and .7 of it where all steps are. The matrices of a `LinearSystem` are factorised
once, before the scan. Each start takes some 12 solves more; `hht(start="simple")` does without, where nothing is stiff.
Internal states go on from `run.z[-1]`. What is held, but known before, is `sampled(order=0)`.

Sweeps
------

Step sizes, parameters, initial states and coefficients are data: any list of step sizes is one compiled call, sampled
at common times, at about the work of its members' own steps. A member that fails is flagged, and leaves the others
alone.

>>> dts = jnp.logspace(-3, -1, 9)                    # made smaller, if need be, to land on the samples: sweep.dt
>>> sweep = hhtjax.sweep(pendulum, hhtjax.hht(), q0, v0, params, dts=dts, duration=2.0, num_samples=20)
>>> sweep.check()
>>> sweep.q.shape
(9, 21, 1)

`times=`, in the place of `duration` and `num_samples`, are sample times at any distances, as of measured data; steps
end at each. `in_axes=`, as for `jax.vmap`, says what else differs between members. `sweep_to_disk` writes chunks of
members as `.npz`, or as one Zarr store, continues where it was killed, and refuses other inputs. With `executor=` the
workers of a cluster run the chunks, whatever they are started by, as `parallel_map` has them run functions of yours.

>>> from concurrent.futures import ThreadPoolExecutor                 # or Dask's client.get_executor(), MPIPoolExecutor
>>> with ThreadPoolExecutor(2) as executor:
...     ends = hhtjax.parallel_map(lambda dt: final_angle(dt, 0.0, 0.5), dts, chunk=3, executor=executor)
>>> ends.shape
(9,)

Where all devices are there from the start, in every process:

    jax.distributed.initialize()
    mesh = jax.make_mesh((jax.device_count(),), ("members",))
    sweep = hhtjax.sweep(pendulum, hhtjax.hht(), q0, v0, params, dts=dts, duration=2.0, num_samples=20, mesh=mesh)

The results are those of one device, to rounding: devices get blocks of members of their own, which XLA may compile
otherwise. What this costs, with large systems (`hht(solve=hhtjax.banded(p))`, or
`conjugate_gradients(k)`, whose steps grow with the number of unknowns) and a step at 1 kHz, is on a page,
`experiments/sweeps/README.md`.

Dense output
------------

`interpolate` gives q, v and internal states at any times inside a run. Derivatives pass through it, so that a fit may
compare at the times of the measurements.

>>> run = hhtjax.simulate(pendulum, hhtjax.hht(), q0, v0, params, dt=1e-2, num_steps=600)
>>> hhtjax.interpolate(run, jnp.array([0.123, 4.56])).q.shape
(2, 1)

It gives accelerations, multipliers and dry friction, too. `simulate(..., times=)` reads a run off at such times while
it goes, and keeps nothing else.

Outputs
-------

`output=` saves a function of the motion in the place of q and v, in `simulate`, `sweep` and `sweep_to_disk`: what
sensors show, energies, a distance. It names what it reads, of q, v, w (the acceleration), L (multipliers), z, zdot,
friction, sticking, contact, t and params. A run of a million steps of a large system then keeps what is asked for.

>>> def felt(q, w, params):
...     return {"height": -params["l"] * jnp.cos(q[0]), "turning": w[0]}
>>> run = hhtjax.simulate(pendulum, hhtjax.hht(), q0, v0, params, dt=1e-2, times=[0.123, 4.56], output=felt)
>>> run.check()
>>> run.q, run.output["height"].shape
(None, (3,))

`hhtjax.measure` shows such an output of a run that has kept q and v, as a sensor with a delay, an offset and a clock of
its own, and `hhtjax.accelerometer` is an output.

Tolerances
----------

`dt=adaptive(rtol, atol)` chooses steps by their errors, in one loop that keeps the samples too. For derivatives, and in
a batch, a run over these steps follows: it is differentiable, and the steps constant. `run.steps` tells how many were
accepted and rejected, `check()` names the time at which there were no more. It pays where a motion has parts of very
different speed, as contacts and relaxation; conservative motions of one time scale want equal steps, whose errors
cancel over a period.

>>> run = hhtjax.simulate(pendulum, hhtjax.hht(), q0, v0, params, dt=hhtjax.adaptive(1e-3, 1e-6), times=[0.123, 4.56])
>>> run.check()
>>> run.q.shape
(3, 1)

An estimate of one step says nothing of what the motion makes of an error later. `verify=True` states the error of the
whole run, `run.error`, at each sample, and `check()` fails above ten times the tolerance. `verify="tighten"` chooses
steps anew, for smaller tolerances, until the error of the run is what was asked for; without it, here, 20 times that.

>>> planet = hhtjax.System(jnp.ones(2), lambda q, v, t, p: -q / jnp.sum(q**2) ** 1.5)
>>> start, year = (jnp.array([0.5, 0.0]), jnp.array([0.0, 3**0.5])), jnp.linspace(0, 2 * jnp.pi, 13)[1:]
>>> for verify in (False, "tighten"):
...     control = hhtjax.adaptive(1e-3, 1e-6, verify=verify)
...     run = hhtjax.simulate(planet, hhtjax.hht(), *start, dt=control, times=year)
...     print(round(float(jnp.max(jnp.abs(run.q[-1] - start[0])) / (1e-3 * jnp.max(jnp.abs(run.q)) + 1e-6)), 2))
19.63
0.76

In a sweep each member has steps of its own, and tolerances may be data: error against tolerance is one call.

>>> rtol = jnp.array([1e-2, 1e-3, 1e-4])
>>> sweep = hhtjax.sweep(
...     pendulum, hhtjax.hht(), q0, v0, params, dts=hhtjax.adaptive(rtol, 1e-3 * rtol), times=[0.123, 4.56])
>>> sweep.q.shape, bool(jnp.all(jnp.diff(sweep.steps.accepted) > 0))
((3, 3, 1), True)

Events
------

`events=[Event(guard, reset=, switch=, terminal=)]`: impacts, end stops, backlash, switches, the end of the run. Where a
guard falls to zero inside a step, the step is taken up to that time, the velocity or the params change, and the step is
finished from there: the grid and the saved times stay, the method keeps its order, and derivatives are exact, that of
the time among them. `run.events` tells what happened, when, and the velocities before and after.

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

Modes, numbers in params that `switch` changes, are how a force jumps: a stop with a damper, a clutch, a broken link.
Here a spring that is only there beyond q = 1:

>>> stop = hhtjax.Event(
...     guard=lambda q, v, t, p: (1.0 - q[0]) * (1 - 2 * p["on"]), switch=lambda p: p | {"on": 1 - p["on"]})
>>> wagon = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, p: -p["on"] * (100 * (q - 1.0) + 2 * v))
>>> run = hhtjax.simulate(
...     wagon, hhtjax.hht(), jnp.zeros(1), jnp.ones(1), {"on": 0.0}, dt=1e-2, num_steps=200, events=[stop])
>>> run.check()
>>> int(run.events.count), round(float(run.events.after[1, 0]), 2)
(2, -0.73)

`switch(q, v, t, params)` sees the state, too. What happens at known times has no guard: `Event(at=times)`, with numbers
or a function of params, divides steps there, and error control ends them there. Runs are differentiable in the times.

>>> brake = hhtjax.Event(at=lambda p: p["time"], switch=lambda p: p | {"force": -0.8})
>>> cart = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, p: p["force"] + 0 * q)
>>> def where(time):
...     params = {"time": time, "force": 0.0}
...     run = hhtjax.simulate(
...         cart, hhtjax.hht(), jnp.zeros(1), jnp.ones(1), params, dt=0.1, num_steps=10, events=[brake])
...     return run.q[-1, 0]
>>> [round(float(f(0.27)), 6) for f in (where, jax.grad(where))]              # 1 - .4 (1 - .27)^2, .8 (1 - .27)
[0.78684, 0.584]

Contact that lasts is a `Contact` of the system (`hhtjax.systems`). In three dimensions, without friction, it can be a
constraint that events switch on and off: on where the body meets its stop, with `impact(0.0)`, off where the multiplier
falls to zero, which a guard sees that has an argument `multipliers`. The number of constraints of a run is fixed, so
one that is off holds a coordinate of its own instead: `hhtjax.scenes.shaken_table` shows it. A body may start at rest
at its guard where its acceleration takes it off.

What fails is named, and never ends behind the wall: more changes in a step than `max_events`, as of a ball that comes
to rest; a motion that stays beyond its guard; two impacts at one time; a start beyond a guard. Derivatives belong to
the order in which events happen; where a motion only grazes a guard they grow without bound (`run.events.rate` tells),
and a guard that falls and rises again within a step is seen where the cubic through its ends sees it.

Events work with mass matrices, constraints (the impulse obeys them), rotations, internal states, dry friction, held
inputs, uneven steps, `interpolate`, `sweep`, `fit`, `extrapolate` (of which the order is 3 then), and with error
control, where samples lie on the motion before or behind an event, and steps that meet more events than one are made
shorter. In a batch of one's own they cost what they cost in `sweep`: the batch looks for events where a member has one.
In `vmap` of a reverse derivative they cost more. Figures, orders, derivatives and an impact oscillator are on a page,
`experiments/events/README.md`.

Extrapolation
-------------

`simulate(..., extrapolate=2)`, or 3, takes the leading errors in dt out of two, or three, runs with steps of dt, dt/2
(and dt/4): order 3 and 4 where the motion is smooth and dt resolves it, 3 with switches of dry friction.
"""
