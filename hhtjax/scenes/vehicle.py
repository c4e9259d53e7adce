"""A passenger vehicle's ride: seven degrees of freedom over a sampled road. SI units.

q = (z, pitch, roll, u_1 ... u_4): heave of the body's centre of mass, its pitch (nose down) and roll (left side up),
both small angles in rad, and the heights of the wheels: front left, front right, rear left, rear right. All are
measured from static equilibrium on flat road, where the springs carry the weight. So the equations contain no gravity.

A corner of the body, x forward and y to the left of the centre of mass, is at the height z - x pitch + y roll. Its
suspension is compressed by d = u - (z - x pitch + y roll). It pushes the body up and the wheel down by

    S = k d + k3 d^3 + c v0 s (1 - r s),    s = d' / sqrt(v0^2 + d'^2)

so the damper has the slope c at rest, saturates beyond the speed v0, and is (1 + r)/(1 - r) times as strong in rebound
as in bump. The tyre pushes the wheel up by k_tyre (road - u). It is linear, so it can also pull. The model is valid
only while no tyre loses all of its static load, as on the default ride.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real
from hhtjax.scenes import drawings
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.sampled import sampled
from hhtjax.systems.system import System

SAMPLING_PERIOD = 1e-3  # s, of the road
SHORTEST, LONGEST = 0.35, 90.0  # m, the waves of the road: the range of ISO 8608
REFERENCE_WAVE_NUMBER = 0.1  # 1/m
RUN_UP = 5.0  # m
BUMP_LENGTH = 2.0  # m


def mass(q: Array, params: PyTree) -> Array:
    """M, diagonal: sprung mass, pitch and roll inertia, four unsprung masses."""
    return jnp.concatenate([params["body"], params["wheel"]])


def corner_heights(q: Array, params: PyTree) -> Array:
    """Heights of the four corners of the body, (4,); with v instead of q, their rates."""
    return q[0] - params["x"] * q[1] + params["y"] * q[2]


def spring(d: Array, params: PyTree) -> Array:
    """k d + k3 d^3."""
    return d * (params["k"] + params["k3"] * d**2)


def damper(rate: Real, params: PyTree) -> Array:
    """c v0 s (1 - r s); rate is positive in bump, negative in rebound."""
    v0 = params["v0"]
    s = rate / jnp.sqrt(v0**2 + rate**2)
    return params["c"] * v0 * s * (1 - params["r"] * s)


def tyre(u: Array, t: Real, params: PyTree) -> Array:
    """k_tyre (road - u): the wheel loads minus the static ones."""
    return params["k_tyre"] * (params["road"](t) - u)


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q: on the body in heave, pitch and roll, and on the four wheels."""
    u = q[3:]
    S = spring(u - corner_heights(q, params), params) + damper(v[3:] - corner_heights(v, params), params)
    body = jnp.stack([jnp.sum(S), -jnp.sum(params["x"] * S), jnp.sum(params["y"] * S)])
    return jnp.concatenate([body, tyre(u, t, params) - S])


def road(
    speed: float, duration: Real, roughness: float = 64e-6, bump: float = 0.05, seed: int = 0, wheelbase: float = 2.7
) -> np.ndarray:
    """Heights of the road under the four wheels at constant speed, every SAMPLING_PERIOD: (samples, 4), in m.

    Each track is a sum of sinusoids with random phases, whose amplitudes follow from the one-sided spectral density
    of ISO 8608 over the wave number n, 1/LONGEST <= n <= 1/SHORTEST, and a bump that begins halfway:

        Gd(n) = roughness (n / 0.1 m^-1)^-2,        bump (1 - cos(2 pi x / BUMP_LENGTH)) / 2

    The bump spans both tracks; the waves of the two are independent of each other. The rear wheels follow the front
    ones at the wheelbase. The road begins flat, and its waves grow to their full height over RUN_UP. A wave has at
    least 8 samples, so that a cubic spline follows it closely.

    Args:
        speed: in m/s, in [1, 40]. duration: in s, at least 3 sampling periods.
        roughness: Gd at 0.1 m^-1, in m^3: 16e-6 for class A, 64e-6 for B, 256e-6 for C; 0 for no waves.
        bump: height in m; negative for a dip, 0 for none.
        seed: seed of the random phases. wheelbase: in m, positive.

    Raises:
        TypeError, ValueError: an argument of the wrong kind or out of its range.

    Reference: ISO 8608 (1995), Mechanical vibration: road surface profiles.

    >>> heights = road(speed=10.0, duration=2.0, roughness=0.0)
    >>> heights.shape
    (2001, 4)
    >>> [round(float(height), 3) for height in heights[1100]]                 # 1 m into the bump: its top
    [0.05, 0.05, 0.0, 0.0]
    """
    for name, value, valid, expectation in (
        ("speed", speed, lambda x: 1 <= x <= 40, "lie in [1, 40] m/s"),
        ("duration", duration, lambda x: 3 * SAMPLING_PERIOD <= x < np.inf, "be finite, at least 3 sampling periods"),
        ("roughness", roughness, lambda x: 0 <= x < np.inf, "be finite and not negative"),
        ("bump", bump, np.isfinite, "be finite"),
        ("wheelbase", wheelbase, lambda x: 0 < x < np.inf, "be positive and finite"),
    ):
        require_number("road", name, value, valid, expectation)
    samples, step = round(duration / SAMPLING_PERIOD) + 1, speed * SAMPLING_PERIOD
    period = max(samples, int(np.ceil(LONGEST / step)))  # number of samples after which the waves repeat
    behind = np.array([0.0, wheelbase])

    n = np.fft.rfftfreq(period, step)
    present = (n >= 1 / LONGEST) & (n <= 1 / SHORTEST)
    density = roughness * np.divide(REFERENCE_WAVE_NUMBER, n, out=np.zeros_like(n), where=present) ** 2
    amplitude = np.sqrt(2 * density / (period * step))
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, n.size)) - 2 * np.pi * n * behind[:, None, None]
    waves = np.fft.irfft(period / 2 * amplitude * np.exp(1j * phase), period)[..., :samples]  # (axle, track, samples)

    x = step * np.arange(samples) - behind[:, None, None]
    begun = np.clip(x / RUN_UP, 0, 1)
    into_bump = np.clip((x - speed * duration / 2) / BUMP_LENGTH, 0, 1)
    heights = begun**2 * (3 - 2 * begun) * waves + bump * (1 - np.cos(2 * np.pi * into_bump)) / 2
    return heights.reshape(4, samples).T


@jax.jit  # one program instead of one for each operation
def road_at(road, t):
    """Heights under the wheels, (4,)."""
    return road(t)


@drawings.Drawing
def drawing(q, t, params: PyTree):
    """The body as a plate, with springs to the wheels, and the road under each wheel; heights are to scale."""
    high, r = 0.7, 0.3  # height of the body over the ground, and radius of a wheel, m
    x, y = params["x"], params["y"]
    corners = np.stack([x, y, high + q[0] - x * q[1] + y * q[2]], axis=-1)
    centres = np.stack([x, y, r + q[3:]], axis=-1)
    below = np.stack([x, y, road_at(params["road"], t)], axis=-1)
    length = np.array([r, 0, 0])
    return [
        drawings.Shape(corners[[0, 1, 3, 2, 0]], "body"),
        *(drawings.wheel(centre, r, up=(0, 0, 1), along=(1, 0, 0)) for centre in centres),
        *(drawings.spring(*ends, 0.12) for ends in zip(centres, corners, strict=True)),
        *(drawings.Shape(np.stack([foot - length, foot + length]), "ground") for foot in below),
    ]


def ride(
    speed: float = 10.0, duration: Real = 4.0, roughness: float = 64e-6, bump: float = 0.05, seed: int = 0
) -> Scene:
    """A mid-size car on the `road` with these arguments. It starts in static equilibrium.

    params: body (3,), sprung mass and pitch and roll inertia; wheel, x, y, k, c, k_tyre (4,), in the order of the
    wheels; k3, v0, r; road, a `hhtjax.sampled` signal of the four heights.

    Args:
        speed: speed of the car, m/s. duration: duration of the run, s.
        roughness: roughness of the road, m^3. bump: height of the bump halfway, m.
        seed: seed of the road.

    Raises:
        TypeError, ValueError: as `road`.
    """
    front, rear, half_track = 1.25, 1.45, 0.75
    params = {
        "body": array([1400.0, 2400.0, 560.0]),
        "wheel": array([40.0, 40.0, 38.0, 38.0]),
        "x": array([front, front, -rear, -rear]),
        "y": array([half_track, -half_track, half_track, -half_track]),
        "k": array([22e3, 22e3, 23e3, 23e3]),
        "k3": 3e6,
        "c": array([2000.0, 2000.0, 1900.0, 1900.0]),
        "v0": 0.4,
        "r": 0.4,
        "k_tyre": array(np.full(4, 200e3)),
        "road": sampled(road(speed, duration, roughness, bump, seed, front + rear), SAMPLING_PERIOD),
    }
    return Scene(System(mass, force), params, array(np.zeros(7)), array(np.zeros(7)), duration, drawing)
