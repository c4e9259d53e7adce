"""Export of a model as C99, or as an FMU, for hard real time and for other programs.

A Python process cannot guarantee deadlines of a millisecond, because the operating system and the garbage collector
interrupt it from time to time. Therefore you can export the step and its parameters. `export_c` writes two files of C99
without dependencies. `export_fmu` writes a functional mock-up unit (FMI 3.0, Co-Simulation) for Simulink, OpenModelica,
Dymola and others.

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

`sensitivities` adds the derivatives with respect to these parameters to the state. Each `sampled` function in params,
such as the torque, becomes an input.

`model.write(folder)` writes arm.c and arm.h. A control loop with them:

    arm_state s;
    double q0[] = {1.0}, v0[] = {0.0}, torque[] = {0.0};
    arm_init(&s, &arm_defaults, q0, v0, torque, 0.0, 1e-3);
    for (;;) {
        wait_for_the_next_millisecond();
        torque[0] = read_torque();
        if (arm_step(&s, &arm_defaults, torque, 1e-3)) { stop(); }  /* ARM_NOT_FINITE, ... */
        use(s.q_arm[0], s.dq_arm_dk[0]);
    }

The C code
----------

The code is a list of operations on single numbers, each evaluated once and stored in a constant. Branches ("auto",
Newton's iteration) stay branches; `jnp.where` is not a branch. Short loops with a fixed count are unrolled. Elimination
with more than eight unknowns is a loop over an array. Singular values, for `redundant="least_squares"`, are computed by
rotations. C and `simulate` agree to rounding. `experiments/export/README.md` has measured step times, and how often a
loop missed its deadline.

Each call of the step reads params and dt. For a `LinearSystem` of more than eight unknowns, the factors of the matrix
are kept in the state. They are computed again when dt, or a parameter of the matrix, changes. That step takes longer,
and needs several times the size of the matrix on the stack. Large constant matrices are written as loops.

Steps under error control, and events, cannot be exported.

C compilers are slow on very large functions: three rigid bodies on joints are 35000 operations and take half a minute.
More than 100000 operations raise an error.
"""
