"""Out of Python: an identified model as C99, or as an FMU, for hard real time and for other programs.

A Python process keeps no deadline of a millisecond: now and then the operating system takes it away, and its own
garbage collection too. So the step, parameters and all, can leave: `export_c` writes it as two files of C99 without
dependencies, `export_fmu` as a functional mock-up unit (FMI 3.0, Co-Simulation) for Simulink, OpenModelica, Dymola and
many more.

>>> import jax.numpy as jnp, hhtjax
>>> def force(q, v, t, params):
...     return {"arm": -params["k"] * q["arm"] - params["c"] * v["arm"] + params["torque"](t)}
>>> arm = hhtjax.System(jnp.array([0.1]), force)
>>> fitted = {"k": 3.0, "c": 0.05, "torque": hhtjax.sampled(jnp.zeros(2), dt=0.1, order=0)}
>>> q0, v0 = {"arm": jnp.ones(1)}, {"arm": jnp.zeros(1)}
>>> model = hhtjax.export_c(arm, hhtjax.hht(), q0, v0, fitted, name="arm", sensitivities=("k",))
>>> [field.name for field in model.state]
['q_arm', 'v_arm', 'w_arm', 'a_arm', 'dq_arm_dk', 'dv_arm_dk', 'dw_arm_dk', 'da_arm_dk']
>>> [field.name for field in model.params], [field.name for field in model.inputs]
(['c', 'k'], ['torque'])

`model.write(folder)` writes arm.c and arm.h. A control loop then is

    arm_state s;
    double q0[] = {1.0}, v0[] = {0.0}, torque[] = {0.0};
    arm_init(&s, &arm_defaults, q0, v0, torque, 0.0, 1e-3);
    for (;;) {
        wait_for_the_next_millisecond();
        torque[0] = read_torque();
        if (arm_step(&s, &arm_defaults, torque, 1e-3)) { stop(); }  /* ARM_NOT_FINITE, ... */
        use(s.q_arm[0], s.dq_arm_dk[0]);
    }

What is written
---------------

The step is evaluated on numbers instead of arrays, each operation once, and printed, one constant for each. Branches
("auto", Newton's iteration, `jnp.where` is none) stay branches, short loops with a fixed count are written out,
eliminations of more than eight unknowns are a loop over a static array, and singular values, of
`redundant="least_squares"`, are found by rotations. So C and `simulate` agree to rounding. The time of a step, and
deadlines kept and missed, are measured on a page, `experiments/export/README.md`.

A step reads params and dt anew. What `simulate` does once, the factors of a `LinearSystem` of more than eight unknowns,
the state keeps, until the params that they are made of, or dt, change: that step takes longer, and on the stack several
times the size of the matrix. Large constant matrices are loops.

Steps under error control, and events, are for `simulate` alone.

C compilers take long over very large functions: three rigid bodies on joints are 35000 operations, and half a minute.
More than 100000 are refused.
"""
