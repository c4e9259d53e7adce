"""`load`: mechanisms from MJCF and URDF files. The package mujoco only reads them (extra `models`).

If a file has features that the equations here do not model, one error lists all of them. `ignore` takes the names of
features to leave out. So an incomplete model is never run by accident. The docstring of `load` lists the names.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hhtjax.bodies.description import SCALARS, WORLD, Body, Connect, Couple, Joint, Marker, Motor, Weld, of_quaternion
from hhtjax.bodies.mechanism import Mechanism, assembled
from hhtjax.bodies.model_parts import (
    Reader,
    is_off,
    num_actuators,
    package,
    strangeness,
    turns,
)
from hhtjax.checks import require_one_of

KNOWN = (
    "contact", "limits", "tendon", "flex", "plugin", "fluid", "mocap", "gravcomp", "actuator", "equality",
    "springyield", "polynomial", "actuatorfrcrange", "unphysical", "massless",
)  # fmt: skip


SMALLEST = 1e-15  # kg, kg m^2, the same of masses and moments: mujoco compiles no body that moves and has less

CHANGED = "stiffness", "rest", "damping", "armature", "friction", "range"  # fields of joints that a file may lack


def load(
    source: Any,
    *,
    ignore: Sequence[str] = (),
    base: str = "fixed",
    joints: dict[str, dict] | None = None,
    more: Sequence[Body] = (),
    motors: Sequence[Motor] = (),
    loops: Sequence[Connect | Weld | Couple] = (),
    markers: Sequence[Marker] = (),
    gravity: Any = None,
    friction: str = "dry",
    limits: str | None = None,
    free: Sequence[str] = (),
) -> Mechanism:
    """A mechanism from an MJCF or URDF file.

    Args:
        source: path of a file, or its text.
        ignore: names of features of the file to be left out; the list is below.
        base: how the root link of a URDF is attached, which the file does not say: "fixed" to the world, or "free". A
            root link named "world" is the world itself; "free" then frees the one link that is fixed to it.
        joints: fields of `Joint` that the file does not contain, by joint name, {"elbow": {"friction": 2.0}}. Fields
            under "*" apply to all hinges and slides.
        more: additional bodies (`Body`), after those of the file, such as a payload on the frame of a tool.
        motors, loops, markers: additional ones.
        gravity: (3,), m/s^2, instead of that of the file. None takes that of the file, which is (0, 0, -9.81) if the
            file does not give it, as in mujoco. (The default of `tree` is standard gravity, 9.80665.)
        friction, free: as in `tree`.
        limits: "ignore", "stop" or "event", as in `tree`; None only if the file has no ranges. "ignore" is the same as
            ignore=("limits",). It is the only choice for a file with a ball joint that has a range: such a cone can be
            neither a stop nor an event here.

    Returns:
        A `Mechanism` with the names of the file, its positions (`qpos`) as coordinates, and q0 = qpos0. Unnamed joints
        and motors are named after their body, BODY_2 and so on, or "actuator" with a number, made unique. A `mimic` of
        a URDF and an equality of joints become a `Couple`; a weld with torquescale 0 becomes a `Connect`. `unsupported`
        lists what was ignored. Motors with an activation (integrator, filter, filterexact) keep it. Their flag
        `actearly` concerns the steps of mujoco and has no effect here.

    What can be ignored:
        "contact": bodies that can touch; ignored, they pass through each other.
        "limits": ranges of joints; ignored, joints move without limits.
        "tendon": tendons with a spring, a damper, friction, a range or an armature.
        "flex": deformable bodies. "plugin": plugins. "fluid": a medium with density or viscosity.
        "mocap": bodies moved from outside; ignored, they stand still. "gravcomp": compensation of gravity at bodies.
        "actuator": motors of kinds that `Motor` does not have: muscles, and those on sites, tendons, balls.
        "actuatorfrcrange": limits of the sum of the forces of all motors of a joint (`effort` in a URDF).
        "equality": constraints other than connect, weld and joint; and a mimic that mujoco does not read.
        "springyield": springs that yield. "polynomial": springs and dampers that are not linear.
        "unphysical": links of a URDF with physically impossible moments of inertia; ignored, all three are replaced by
            their mean.
        "massless": bodies with an inertia but no mass; ignored, they lose the inertia. Also joints of a URDF without
            armature that move no mass or turn no inertia; ignored, they are fixed. Instead of ignoring them, add an
            armature with `joints`, or a mass with `more`.

    Raises:
        ImportError: mujoco is not installed. FileNotFoundError: no such file.
        NotImplementedError: the file has features that are not modelled; all are listed.
        TypeError, ValueError: an argument of a wrong kind or value; "limits" both ignored and used; a file that mujoco
            cannot read, with mujoco's message; joints that can move without moving a mass, as in `tree`.

    >>> from hhtjax import bodies
    >>> pendulum = bodies.load('''<mujoco><worldbody><body name="rod">
    ...     <joint name="pivot" axis="0 1 0" frictionloss="0.1" damping="0.02"/>
    ...     <inertial mass="1" pos="0 0 -0.5" diaginertia="0.08 0.08 0.001"/></body></worldbody></mujoco>''')
    >>> pendulum.joints, float(pendulum.params["frictionloss"][0])
    (('pivot',), 0.1)
    """
    for name in ignore:
        require_one_of("load", "ignore", name, KNOWN)
    require_one_of("load", "base", base, ("fixed", "free"))
    if "limits" in ignore and limits in ("stop", "event"):
        raise ValueError(f'load: `ignore` contains "limits", but `limits` is {limits!r}: give one of them.')
    limits = "ignore" if "limits" in ignore else limits
    model, acting, given = _compiled(source, base)
    parts = Reader(model, given)
    acting += _acting(parts, limits, bool(motors))
    of_file = _with_changes(parts.bodies(), joints or {})
    idle = _moving_nothing(of_file, list(more)) if given else []
    if idle:
        acting.append(("massless", f"joints that move no mass or turn no inertia, and have no armature: {_some(idle)}"))
    ignored = {*ignore, "limits"} if limits == "ignore" else {*ignore}
    refused = [(name, what) for name, what in acting if name not in ignored]
    if refused:
        words = "\n".join(f"    {name}: {what}" for name, what in refused)
        names = ", ".join(f'"{name}"' for name in dict(refused) if name != "limits" or limits is None)
        way = f"Ignore them by name, ignore=({names},), or change" if names else "Change `limits`, or"
        raise NotImplementedError(f"load: the file has features that are not modelled:\n{words}\n{way} the file.")
    unsupported = tuple(f"{name}: {what}" for name, what in acting)
    of_file = [body.with_joints(joint for joint in body.joints if joint.name not in idle) for body in of_file]
    ties = [loop for loop in parts.loops() if not (isinstance(loop, Couple) and {loop.first, loop.second} & {*idle})]
    return assembled(
        "load", of_file + list(more), parts.motors() + list(motors), ties + list(loops),
        parts.markers() + list(markers), parts.gravity if gravity is None else gravity, friction,
        limits, free, unsupported,
    )  # fmt: skip


def _moving_nothing(bodies: list[Body], more: list[Body]) -> list:
    """Names of the joints without armature that move no mass, or turn no inertia, in any position."""
    frames, above = {WORLD: (np.eye(3), np.zeros(3))}, {}
    for body in [*bodies, *more]:
        if body.parent not in frames:
            continue  # `assembled` says so
        R, x = frames[body.parent]
        frames[body.name] = R @ np.reshape(body.rotation, (3, 3)), x + R @ np.asarray(body.position)
        above[body.name] = {body.name} | above.get(body.parent, set())
    movable = {body.name for body in [*bodies, *more] if body.joints}
    heavy = [body for body in [*bodies, *more] if body.mass > SMALLEST and body.name in above]

    def moves(body: Body, joint: Joint) -> bool:
        """Whether the joint accelerates any mass or inertia."""
        carried = [part for part in heavy if body.name in above[part.name]]
        further = any(movable & (above[part.name] - above[body.name]) for part in carried)
        if joint.kind != "revolute" or further:  # what is on its axis here may leave it
            return bool(carried)
        R, x = frames[body.name]
        axis, centre, inertia = R @ np.asarray(joint.axis), x + R @ np.asarray(joint.anchor), 0.0
        for part in carried:
            S, y = frames[part.name]
            arm = np.cross(axis, y + S @ np.asarray(part.com) - centre)
            inertia += axis @ S @ np.reshape(part.inertia, (3, 3)) @ S.T @ axis + part.mass * (arm @ arm)
        return bool(inertia > SMALLEST)

    return [joint.name for body in bodies for joint in body.joints if not (joint.armature or moves(body, joint))]


def _with_changes(bodies: list[Body], joints: dict) -> list[Body]:
    """The bodies with additional fields of their joints."""
    names = [joint.name for body in bodies for joint in body.joints]
    for name, values in joints.items():
        require_one_of("load", "joints", name, ("*", *names))
        for field in values:
            require_one_of("load", f"joints[{name!r}]", field, CHANGED)

    def changed(joint: Joint) -> Joint:
        values = (joints.get("*", {}) if joint.kind in SCALARS else {}) | joints.get(joint.name, {})
        return replace(joint, **values) if values else joint

    return [body.with_joints(map(changed, body.joints)) for body in bodies]


def _compiled(source: Any, base: str):
    """The model as compiled by mujoco, features that mujoco then does not show, and masses that were replaced for
    compiling."""
    mujoco = package()
    text, folder = _text(source)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"load: `source` is not valid XML: {error}.") from None
    if root.tag not in ("robot", "mujoco"):
        raise ValueError(f"load: `source` must be MJCF (mujoco) or URDF (robot); its root is {root.tag!r}.")
    acting, given = [], {}
    if base == "free":
        _require_one_root(root)
    try:
        if root.tag == "mujoco":
            spec = mujoco.MjSpec.from_file(os.fspath(source)) if folder else mujoco.MjSpec.from_string(text)
        else:
            acting = _simplified(root)
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
            if base == "free":
                spec.worldbody.first_body().add_freejoint()
            given = _without_strange_masses(spec, acting)
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"load: mujoco cannot read `source`: {error}") from None
    coupled = {model.jnt(int(j)).name for j in model.eq_obj1id}  # a URDF has no other constraints
    movable = [joint for joint in root.findall("joint") if joint.get("type") != "fixed"]
    mimics = [joint.get("name") for joint in movable if joint.find("mimic") is not None]
    unread = [name for name in mimics if name not in coupled] if root.tag == "robot" else []
    if unread:
        acting.append(("equality", f"mimic of {_some(unread)}, which mujoco does not read"))
    return model, acting, given


def _without_strange_masses(spec, acting: list) -> dict:
    """Replaces masses that mujoco does not compile by 1. Returns the true mass, com and inertia, by body."""
    given, unphysical, massless = {}, [], []
    for body in spec.bodies[1:]:
        x = body.fullinertia
        inertia = np.array([[x[0], x[3], x[4]], [x[3], x[1], x[5]], [x[4], x[5], x[2]]])
        inertia = np.diag(body.inertia) if np.isnan(x[0]) else inertia
        moments, axes = np.linalg.eigh(inertia)
        strange = moments[0] <= SMALLEST or moments[2] > moments[0] + moments[1] or body.mass <= SMALLEST
        if not strange or not (body.explicitinertial or len(body.joints)):
            continue
        if np.max(np.abs(moments)) <= SMALLEST:
            moments = np.zeros(3)
        elif body.mass <= SMALLEST:
            massless.append(body.name)
            moments = np.zeros(3)
        elif moments[0] < -1e-6 * moments[2] or moments[2] > (moments[0] + moments[1]) + 1e-6 * moments[2]:
            unphysical.append(body.name)
            moments = np.full(3, max(np.mean(moments), 0.0))
        elif moments[0] < 0:  # a rod, but for rounding
            moments = np.maximum(moments, 1e-12 * moments[2])
        R = of_quaternion(body.iquat) @ axes
        com = np.where(np.isnan(body.ipos), 0.0, body.ipos)
        given[body.name] = float(body.mass), com, R @ np.diag(moments) @ R.T
        body.mass, body.ipos, body.inertia, body.explicitinertial = 1.0, com, np.ones(3), True
        body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
    if unphysical:
        acting.append(("unphysical", f"moments of inertia that no body has: {_some(unphysical)}"))
    if massless:
        acting.append(("massless", f"inertia without mass of {_some(massless)}"))
    return given


def _require_one_root(root):
    """Raises an error for a root link "world" that carries more than one fixed link; mujoco makes this link the
    world."""
    if root.tag == "mujoco":
        raise ValueError('load: `base` is for URDF; an MJCF file itself says which bodies are free; received "free".')
    held = [joint for joint in root.iter("joint") if getattr(joint.find("parent"), "attrib", {}).get("link") == WORLD]
    if len(held) > 1 or any(joint.get("type") != "fixed" for joint in held):
        names = _some([f"{joint.get('name')} ({joint.get('type')})" for joint in held])
        raise ValueError(
            f'load: `base` is "free", and the root link of the URDF is "world", which does not move. Only one link '
            f"that is fixed to it can be freed; it carries the joints {names}. Rename the link."
        )


def _text(source: Any):
    """The text of the model, and whether it came from a file."""
    if isinstance(source, str) and source.lstrip().startswith("<"):
        return source, False
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(f"load: `source` must be a path, or the text of a file; received {source!r}.")
    with open(source, encoding="utf-8") as file:
        return file.read(), True


def _simplified(root) -> list:
    """Removes the shapes of a URDF, whose files are often missing, and keeps all links. Returns features that only this
    function sees."""
    acting = []
    touching = [link.get("name") for link in root.iter("link") if link.find("collision") is not None]
    if touching:
        acting.append(("contact", f"collision shapes of {_some(touching)}"))
    for link in root.iter("link"):
        for tag in ("visual", "collision"):
            for shape in link.findall(tag):
                link.remove(shape)
    for tag in ("transmission", "gazebo"):
        for element in root.findall(tag):
            root.remove(element)
    extension = root.find("mujoco")
    extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.set("fusestatic", "false")
    return acting


def _some(names: list) -> str:
    """At most five of the names, in words."""
    return ", ".join(map(str, names[:5])) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _acting(parts: Reader, limits: str | None, motors: bool) -> list:
    """The features of a compiled model that the equations here do not have: (name, words)."""
    mujoco, m = package(), parts.m
    found: list = []

    def add(name: str, what: str, here):
        if np.any(here):
            found.append((name, what))

    def names(kind: str, here) -> str:
        return _some([parts.names[kind][i] for i in np.flatnonzero(here)])

    off = m.opt.disableflags
    if not off & (int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)):
        add("contact", "shapes that can touch", m.npair > 0 or _can_touch(m))
    limited = (m.jnt_limited > 0) & (not is_off(off, "LIMIT", "CONSTRAINT"))
    if limits is None:
        add("limits", f"ranges of {names('joint', limited)} (limits= takes them as stops or events)", limited)
    elif limits == "ignore":
        add("limits", f"ranges of {names('joint', limited)}", limited)
    balls = limited & (m.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL))
    if limits != "ignore":
        add("limits", f'cones of the balls {names("joint", balls)}, for which there is only limits="ignore"', balls)
    if m.ntendon:
        acts = (
            (m.tendon_stiffness != 0) | (m.tendon_damping != 0) | (m.tendon_frictionloss != 0) | (m.tendon_limited > 0)
        )
        for name in ("tendon_armature", "tendon_stiffnesspoly", "tendon_dampingpoly"):
            acts = acts | np.any(np.reshape(getattr(m, name, np.zeros(m.ntendon)), (m.ntendon, -1)) != 0, axis=1)
        add("tendon", names("tendon", acts), acts)
    add("flex", "deformable bodies", m.nflex > 0)
    add("plugin", "plugins", m.nplugin > 0)
    add("fluid", "a medium with density or viscosity", m.opt.density > 0 or m.opt.viscosity > 0)
    add("mocap", "bodies moved from outside", m.nmocap > 0)
    add("gravcomp", names("body", m.body_gravcomp), m.body_gravcomp)
    for attribute, name, kind in (
        ("jnt_springyield", "springyield", "joint"),
        ("jnt_stiffnesspoly", "polynomial", "joint"),
        ("dof_dampingpoly", "polynomial", None),
    ):
        values = getattr(m, attribute, None)
        if values is not None and np.size(values):
            acts = np.any(np.reshape(values, (len(values), -1)) != 0, axis=1)
            add(name, names(kind, acts) if kind else "damping that is not linear", acts)
    rotors = np.flatnonzero(getattr(m, "actuator_armature", np.zeros(0))).tolist()
    unseen = [i for i in rotors if not turns(m, i)]
    add("actuator", f"rotors of motors that are on no hinge or slide ({len(unseen)})", unseen)
    massless = (m.body_mass == 0) & np.any(m.body_inertia != 0, axis=1)
    add("massless", f"inertia without mass of {names('body', massless)}", massless)
    if (num_actuators(m) or motors) and not is_off(off, "ACTUATION"):
        add("actuatorfrcrange", names("joint", m.jnt_actfrclimited), m.jnt_actfrclimited)
    if num_actuators(m) and not is_off(off, "ACTUATION"):
        strange = np.array([strangeness(m, i) is not None for i in range(num_actuators(m))])
        words = "; ".join(
            f"{parts.names['actuator'][i]} ({strangeness(m, int(i))})" for i in np.flatnonzero(strange)[:5]
        )
        add("actuator", words, strange)
    if m.neq and not is_off(off, "EQUALITY", "CONSTRAINT"):
        here = (m.eq_active0 > 0) & ~np.isin(
            m.eq_type, [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD), int(mujoco.mjtEq.mjEQ_JOINT)]
        )
        add("equality", f"constraints of other kinds ({int(np.sum(here))})", here)
    return found


def _can_touch(m) -> bool:
    """Whether two shapes of different bodies may collide, by their contact bits and by the tree of bodies."""
    filtered = not is_off(m.opt.disableflags, "FILTERPARENT")
    excluded = [_pair(int(s) >> 16, int(s) & 0xFFFF) for s in m.exclude_signature]
    shapes = np.stack([m.geom_contype, m.geom_conaffinity, m.geom_bodyid], axis=1).astype(np.int64)
    shapes = np.unique(shapes[(shapes[:, :2] != 0).any(axis=1)], axis=0)
    kinds, likes, body = shapes.T
    fixed = m.body_weldid[body]
    above = m.body_weldid[m.body_parentid[fixed]]
    for i in range(len(shapes) - 1):
        later = slice(i + 1, None)
        meets = ((kinds[i] & likes[later]) | (kinds[later] & likes[i])) != 0
        meets &= (fixed[later] != fixed[i]) & ~np.isin(_pair(body[i], body[later]), excluded)
        if filtered:  # a parent and its child, but for the world
            related = (above[i] == fixed[later]) | (above[later] == fixed[i])
            meets &= ~(related & (fixed[i] != 0) & (fixed[later] != 0))
        if meets.any():
            return True
    return False


def _pair(a: Any, b: Any) -> Any:
    """A key for two bodies in either order."""
    return np.minimum(a, b) * 65536 + np.maximum(a, b)
