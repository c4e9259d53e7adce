# %% [markdown]
# # 4. Mechanisms with constraints, and rotations
#
# Many mechanisms are easier to describe with more coordinates than degrees of freedom. For
# example, use the positions of the joints, and require that the bars keep their lengths. The
# library simulates such systems directly,
#
# $$M(q)\,\ddot q = Q(q, \dot q, t) + B^T \lambda, \quad \Phi(q, t) = 0, \quad
# B = \partial\Phi/\partial q,$$
#
# and returns the **multipliers** $\lambda$, which give the constraint forces. The first
# example is a Watt linkage in the plane, the second a body that rotates freely in space.

# %%
import base64
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
from IPython.display import HTML, display

import hhtjax

jax.config.update("jax_enable_x64", True)
plt.rcParams.update(hhtjax.plot.styles.PARAMETERS)

# %% [markdown]
# ## Watt's linkage
#
# Two rockers of 0.4 m turn about fixed pivots. A coupler of 0.2 m joins their ends. Its
# middle P moves almost on a straight line. Steam engines used this to guide piston rods, and
# cars use it to guide rear axles.
#
# The coordinates are the positions of the two joints, (2, 2), in m. Three bars give three
# constraints, so one degree of freedom is left. The mass matrix of a slender bar with moving
# ends is $m/6\,[2\ 1;\ 1\ 2]$ for each direction. An axle of 5 kg is attached to P and held
# by a spring.

# %%
PIVOTS = jnp.array([[0.0, 0.0], [0.8, 0.2]])
params = {
    "rocker": 0.4,
    "coupler": 0.2,
    "bar": 1.0,
    "axle": 5.0,
    "k": 1500.0,
    "g": 9.81,
}  # m, kg, N/m, m/s^2


def mass(q, params):
    """Rows in the order of ravelled q: x and y of the first joint, then of the second."""
    bars = (
        params["bar"] / 6 * jnp.array([[2.0 + 2.0, 1.0], [1.0, 2.0 + 2.0]])
    )  # a rocker and the coupler at each joint
    axle = params["axle"] / 4 * jnp.ones((2, 2))  # P is the mean of both joints
    return jnp.kron(bars + axle, jnp.eye(2))


def middle(q):
    return (q[0] + q[1]) / 2


def potential(q, t, params):
    weight = params["g"] * (params["bar"] * jnp.sum(q[:, 1]) + params["axle"] * middle(q)[1])
    return weight + params["k"] / 2 * (middle(q)[1] - 0.1) ** 2


def force(q, v, t, params):
    return -jax.grad(potential)(q, t, params)  # no need to derive it by hand


def constraint(q, t, params):
    """Squared length of each bar, less what it should be."""
    bars = jnp.stack([q[0] - PIVOTS[0], q[1] - PIVOTS[1], q[1] - q[0]])
    lengths = jnp.stack([params["rocker"], params["rocker"], params["coupler"]])
    return (jnp.sum(bars**2, axis=1) - lengths**2) / 2


watt = hhtjax.System(mass, force, constraint)

# %% [markdown]
# Initial values must satisfy the constraints and their time derivatives. `consistent_initial`
# takes a guess and returns the nearest values that do.

# %%
guess = jnp.array([[0.39, 0.07], [0.41, 0.27]])
start = hhtjax.consistent_initial(watt, guess, jnp.zeros((2, 2)), params)
print("joints:", start.q.round(4).tolist())
run = hhtjax.simulate(
    watt, hhtjax.hht(alpha=0.0), start.q, start.v, params, dt=1e-3, num_steps=1000
)
run.check()


def points(q):
    """The mechanism as lines to draw: the coupler with its middle first, then the rockers."""
    return [
        jnp.stack([q[0], middle(q), q[1]]),
        jnp.stack([PIVOTS[0], q[0]]),
        jnp.stack([PIVOTS[1], q[1]]),
    ]


figure, (left, right) = hhtjax.plot.subplots(1, 2, width=175, height=80)
hhtjax.plot.configuration(run, points, [0.0, 0.05, 0.1, 0.2], ax=left)
P = jax.vmap(middle)(run.q)
left.plot(P[:, 0], P[:, 1], color="black", lw=1)
right.plot(1e3 * (P[:, 0] - 0.4), P[:, 1])
right.set(xlabel="sideways place of P, less 0.4 m (mm)", ylabel="height of P (m)")
plt.show()
print(
    f"P moves {1e3 * jnp.ptp(P[:, 1]):.0f} mm up and down, and "
    f"{1e3 * jnp.ptp(P[:, 0]):.2f} mm sideways"
)

# %% [markdown]
# The same motion as a film:

# %%
film = hhtjax.plot.animation(run, points, fps=12, speed=0.4, trace=1)
with tempfile.TemporaryDirectory() as folder:
    film.save(Path(folder) / "watt.gif", writer="pillow", dpi=90)
    plt.close()
    content = base64.b64encode((Path(folder) / "watt.gif").read_bytes()).decode()
print(f"{len(content) // 1000} kB")
display(HTML(f'<img alt="Watt linkage swinging" src="data:image/gif;base64,{content}">'))

# %% [markdown]
# ## Are constraints and energy kept?
#
# By default every step enforces both $\Phi = 0$ and $\dot\Phi = 0$, so there is no drift. The
# energy balance compares kinetic and potential energy with the work of all other forces. Here
# there are none.

# %%
balance = hhtjax.analysis.energy_balance(watt, run, params, potential=potential)
swing = float(jnp.ptp(balance.potential))
print(f"largest |Phi| {run.info.constraint.max():.1e} m^2")
print(
    f"energy made or lost: at most {float(jnp.abs(balance.error).max()) / swing:.1e} of "
    f"the {swing:.2f} J that swing"
)

# %% [markdown]
# ## Forces in the bars
#
# The constraint of a bar is half its squared length. So $B^T\lambda$ is $\lambda$ times the
# vector of the bar, and the force along the bar is $\lambda$ times its length. A positive
# force pushes the ends apart.

# %%
lengths = jnp.array([params["rocker"], params["rocker"], params["coupler"]])
thrust = run.multipliers * lengths
figure, axes = hhtjax.plot.subplots(width=175, height=60)
for i, name in enumerate(("left rocker", "right rocker", "coupler")):
    axes.plot(run.t, thrust[:, i], ("-", "--", ":")[i], label=name)
axes.axhline(0, color="black", lw=0.5)
axes.set(xlabel="time (s)", ylabel="thrust in the bar (N)")
figure.legend(loc="outside upper center", ncols=3)
plt.show()

# %% [markdown]
# ## A derivative through the mechanism
#
# Lengths in the constraint are parameters too. What changes if the coupler is a little
# longer? We differentiate the height of P after one second with respect to the coupler's
# length. The initial position depends on that length as well. `consistent_initial` is
# differentiated along with the run.


# %%
def height_after_a_second(coupler):
    new = params | {"coupler": coupler}
    start = hhtjax.consistent_initial(watt, guess, jnp.zeros((2, 2)), new)
    run = hhtjax.simulate(
        watt, hhtjax.hht(0.0), start.q, start.v, new, dt=1e-3, num_steps=1000, save_every=1000
    )
    return middle(run.q[-1])[1]


height_and_slope = jax.jit(lambda coupler: jax.jvp(height_after_a_second, (coupler,), (1.0,)))
_, slope = height_and_slope(0.2)
around = [height_and_slope(0.2 + change)[0] for change in (1e-5, -1e-5)]
print(
    f"{slope:.5f} by differentiation, {(around[0] - around[1]) / 2e-5:.5f} by finite "
    "differences (m per m)"
)

# %% [markdown]
# ## Rotations
#
# A rotation is a matrix R (3, 3) in `q`, from the body's axes to those of the room. Its
# velocity is the angular velocity $\Omega$ (3,) in the body's axes, not the derivative of the
# matrix. You need nothing else: there are no angles that become singular and no quaternions
# to normalise.
#
# A book that is thrown with a spin about its middle axis tumbles. This follows from Euler's
# equations, $J\dot\Omega = -\Omega \times J\Omega$.


# %%
def gyroscopic(R, Om, t, params):
    return -jnp.cross(Om, params["J"] * Om)


book = hhtjax.System(mass=lambda R, params: params["J"], force=gyroscopic)
J = jnp.array([1.0, 2.0, 2.7]) * 1e-3  # kg m^2
spins = {
    "least": [10.0, 0.01, 0.01],
    "middle": [0.01, 10.0, 0.01],
    "largest": [0.01, 0.01, 10.0],
}
tumble = {
    name: hhtjax.simulate(
        book,
        hhtjax.hht(alpha=0.0),
        jnp.eye(3),
        jnp.array(spin),
        {"J": J},
        dt=2e-3,
        num_steps=4000,
        save_every=4,
    )
    for name, spin in spins.items()
}

figure, axes = hhtjax.plot.subplots(1, 3, width=175, height=55, sharey=True)
for i, (axis, (name, run)) in enumerate(zip(axes, tumble.items(), strict=True)):
    axis.plot(run.t, run.q[:, i, i])
    axis.set(title=f"axis of {name} inertia", xlabel="time (s)", ylim=(-1.1, 1.1))
axes[0].set_ylabel("cosine of the angle\nbetween the axis now and at t = 0")
plt.show()

for name, run in tumble.items():
    spatial = jnp.einsum("tij,tj->ti", run.q, J * run.v)  # angular momentum in the room
    drift = float(jnp.max(jnp.abs(spatial - spatial[0])) / jnp.linalg.norm(spatial[0]))
    off = float(jnp.max(jnp.abs(run.q @ run.q.swapaxes(1, 2) - jnp.eye(3))))
    print(f"{name:<8} angular momentum kept to {drift:.0e}, R orthogonal to {off:.0e}")

# %% [markdown]
# **Look at** the lines. About the axes of least and largest inertia the body spins steadily,
# and the cosine stays constant. About the middle axis it turns over. This is a property of
# the equations, not of the method. Nothing enforces the angular momentum, but it is kept to
# the numbers printed above. R stays orthogonal to rounding.
#
# For mechanisms in space you need not write equations: `hhtjax.bodies` makes them from bodies
# and joints, or from files. See `hhtjax.scenes.body_chain`, rods on ball joints, and
# `hhtjax.scenes.arm`.
#
# ## What to try next
#
# * Move the left pivot of the linkage 20 mm up. How straight is the path of P now?
#   `hhtjax.fit` can find the best position of a pivot, with the sideways motion as residual.
# * Add a fourth bar that does not change the motion. The constraints then depend on each
#   other, and the error says which. `hht(redundant="least_squares")` solves them anyway.
# * Spin the book about its middle axis with exactly (0, 10, 0). Why does it not tumble?
