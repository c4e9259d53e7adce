"""Finite elements: beams, cables, springs and joints, as plain functions of one element.

A structure consists of nodes, and of elements between them. The state q is a dict; the first axis of its leaves counts
the nodes. The elements determine which leaves it has:

    bars, springs          {"r": (N, d)}                             positions, m; d = 2 or 3
    bodies in the plane    {"r": (N, 2), "theta": (N,)}              positions, m, and angles, rad
    bodies in space        {"r": (N, 3), "R": (N, 3, 3)}             positions, m, and rotations; see `hhtjax.rotation`
    ANCF cables            {"r": (N, d), "slope": (N, d)}            positions, m, and slopes dr/dx

v is structured like q, except for rotations: its leaf "R" is (N, 3), the angular velocity Om in material components,
with Rdot = R hat(Om). Forces are structured like v: "theta" holds moments in the plane, "R" moments in material
components.

A function computes one element. It receives q and v of its k nodes only, with leaves (k, ...), and `each`, a dict with
the data of this element: lengths, stiffnesses. There are three kinds:

    force    f(q, v, t, params, each)    the force on its nodes, like v: -dV/dq of an energy V
    mass     m(q, w, params, each)       M w of an acceleration w, like v
    joint    j(q, t, params, each)       rows that are 0 if the joint is closed

A result may omit leaves that are zero. One `each` may serve several functions of this folder: names that another
function needs are accepted, and an unknown name is an error. You can use your own functions as elements in the same
way. `jax.vmap` evaluates a function for many elements. All functions support `jit`, `grad` and `jacfwd`, also in the
undeformed state.

A beam of two elements, clamped at one end, bent into a quarter of a circle by the moment EI pi/(2 length) at the other:

>>> import jax, jax.numpy as jnp
>>> from hhtjax import elements
>>> pairs = jnp.array([[0, 1], [1, 2]])                                       # the nodes of each element
>>> each = {"L": jnp.ones(2), "EA": jnp.full(2, 1e3), "GA": jnp.full(2, 4e2), "EI": jnp.full(2, 5.0)}
>>> along = jnp.array([0.0, jnp.pi / 4, jnp.pi / 2])                          # the angles of a circle
>>> r = jnp.stack([jnp.sin(along), 1 - jnp.cos(along)], axis=1) / (2 * jnp.sin(jnp.pi / 8))   # sides have length L
>>> q = {"r": r, "theta": along}
>>> of_nodes = jax.tree.map(lambda x: x[pairs], q)                            # leaves (2 elements, 2 nodes, ...)
>>> force = jax.vmap(elements.planar_beam, in_axes=(0, 0, None, None, 0))
>>> found = force(of_nodes, jax.tree.map(jnp.zeros_like, of_nodes), 0.0, {}, each)
>>> moment = jnp.zeros(3).at[pairs].add(found["theta"])                       # what the beam asks of its nodes
>>> print((moment / (5.0 * jnp.pi / 4)).round(6) + 0.0)                       # pulls back at the end
[ 1.  0. -1.]

Which element
-------------

`planar_beam` and `spatial_beam` are geometrically exact: stretch, shear, bending and twist may be arbitrarily large.
They converge with order 2. Their nodes are bodies, to which joints can be attached. `ancf_cable` is for thin cables and
beams: it has no shear and no twist, and its mass is constant and has no rotations. It converges with order 4 on fine
meshes. `truss` and `spring_damper` act along a line, `torsion_spring` about an axis. `gravity` is the weight. Nodes
that rotate in space need `gyroscopic`.

The mass of beams is `planar_mass` or `spatial_mass`, consistent with their shape, or diagonal: `planar_lumped_mass`,
`spatial_lumped_mass`. Lumped masses make steps cheaper; both converge with order 2. ANCF cables need `ancf_mass`.

Joints
------

`pin` (a ball joint in space), `weld`, `revolute`, `slider`, `prismatic` and `rigid_link` connect two bodies. With one
node they connect a body to the ground. Points of bodies are given by offsets, "a" on the first and "b" on the second.
"""

from hhtjax.elements.ancf import ancf_cable, ancf_mass
from hhtjax.elements.joints import pin, prismatic, revolute, rigid_link, slider, weld
from hhtjax.elements.nodal import gravity, gyroscopic
from hhtjax.elements.planar import planar_beam, planar_lumped_mass, planar_mass, planar_strain
from hhtjax.elements.spatial import spatial_beam, spatial_lumped_mass, spatial_mass, spatial_strain
from hhtjax.elements.springs import spring_damper, torsion_spring, truss

__all__ = [
    "ancf_cable",
    "ancf_mass",
    "gravity",
    "gyroscopic",
    "pin",
    "planar_beam",
    "planar_lumped_mass",
    "planar_mass",
    "planar_strain",
    "prismatic",
    "revolute",
    "rigid_link",
    "slider",
    "spatial_beam",
    "spatial_lumped_mass",
    "spatial_mass",
    "spatial_strain",
    "spring_damper",
    "torsion_spring",
    "truss",
    "weld",
]
