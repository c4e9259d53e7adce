"""Mechanisms from MJCF and URDF files. The package mujoco reads them, and does nothing else (extra `models`).

What acts in a file and is not in the equations here is refused in one list, unless it is ignored by name: a model
that is missing something is not run by accident. Names:

    "contact"            bodies that can touch
    "limits"             ranges of joints, unless `limits` says what they are
    "tendon", "flex", "plugin", "fluid", "mocap", "gravcomp"
    "actuator"           motors of other kinds than `Motor`: muscles, on sites, tendons, balls
    "equality"           constraints other than connect, weld, joint and mimic, which are loops here
    "springyield", "polynomial", "actuatorfrcrange"
    "unphysical"         links of a URDF with an inertia that no body has
    "massless"           bodies with an inertia and no mass
"""

from __future__ import annotations

import importlib
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hhtjax.bodies.description import SCALARS, WORLD, Body, Connect, Couple, Joint, Marker, Motor, Weld, of_quaternion
from hhtjax.bodies.mechanism import Mechanism, assembled
from hhtjax.checks import require_one_of

KNOWN = (
    "contact", "limits", "tendon", "flex", "plugin", "fluid", "mocap", "gravcomp", "actuator", "equality",
    "springyield", "polynomial", "actuatorfrcrange", "unphysical", "massless",
)  # fmt: skip

SHORTEST = 1e-15  # s, mujoco's mjMINVAL, below which no filter is

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
        ignore: names of what acts in the file and is to be left out: "contact", shapes that can touch; "limits",
            ranges of joints; "tendon", "flex", "plugin", "fluid", "mocap", "gravcomp"; "actuator", muscles, motors on
            sites, tendons and balls; "equality", constraints other than connect, weld, joint and mimic; "springyield"
            and "polynomial", springs and dampers that are not linear; "actuatorfrcrange", limits of a joint's torque;
            "unphysical", links of a URDF with an inertia that no body has; "massless", an inertia without mass.
        base: of a URDF, which does not say it: "fixed" to the world, or "free". A root link named "world" is the world
            itself: "free" lets the one link loose that is fixed to it.
        joints: what the file does not say of its joints: fields of `Joint` by name, {"elbow": {"friction": 2.0}}; those
            under "*" are of all hinges and slides.
        more: further bodies (`Body`), behind those of the file, such as a payload on the frame of a tool.
        motors, loops, markers: further ones.
        gravity: (3,), m/s^2, in the place of that of the file; None for the latter, which is (0, 0, -9.81) where the
            file says nothing, as in mujoco. (The default of `tree` is standard gravity, 9.80665.)
        friction, free: as in `tree`.
        limits: "ignore", "stop" or "event", as in `tree`; None if there are none.

    Returns:
        A `Mechanism`, with the names of the file, its positions (`qpos`) as coordinates, and q0 = qpos0.
        `unsupported` lists what was ignored. Motors with an activation (integrator, filter, filterexact) have one here.
        Their flag `actearly` is about the steps of mujoco, and makes no difference here.

    Raises:
        ImportError: mujoco is not installed. FileNotFoundError: no such file.
        NotImplementedError: something acts that is not modelled: the whole list.
        TypeError, ValueError: an argument of a wrong kind or value; a file that mujoco cannot read, in its words.

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
    model, acting = _compiled(source, base)
    acting += _acting(model, limits, bool(motors))
    refused = [(name, what) for name, what in acting if name not in ignore]
    if refused:
        words = "\n".join(f"    {name}: {what}" for name, what in refused)
        names = ", ".join(f'"{name}"' for name in dict(refused))
        raise NotImplementedError(
            f"load: the file holds what acts and is not modelled:\n{words}\nLeave it out by name, ignore=({names},), or"
            " change the file."
        )
    unsupported = tuple(f"{name}: {what}" for name, what in acting)
    parts = _Reader(model)
    of_file = _with_changes(parts.bodies(), joints or {})
    return assembled(
        "load", of_file + list(more), parts.motors() + list(motors), parts.loops() + list(loops),
        parts.markers() + list(markers), parts.gravity if gravity is None else gravity, friction,
        "ignore" if limits is None and "limits" in ignore else limits, free, unsupported,
    )  # fmt: skip


def _with_changes(bodies: list[Body], joints: dict) -> list[Body]:
    """The bodies with further fields of their joints."""
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
    """The model as mujoco compiles it, and what its text holds that acts and that mujoco does not see then."""
    mujoco = _mujoco()
    text, folder = _text(source)
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"load: `source` is no XML: {error}.") from None
    if root.tag not in ("robot", "mujoco"):
        raise ValueError(f"load: `source` must be MJCF (mujoco) or URDF (robot); its root is {root.tag!r}.")
    acting = []
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
        return spec.compile(), acting
    except ValueError as error:
        raise ValueError(f"load: mujoco cannot read `source`: {error}") from None


def _require_one_root(root):
    """An error for a root link "world" that carries more than one fixed link: mujoco makes it the world itself."""
    if root.tag == "mujoco":
        raise ValueError('load: `base` is for URDF; MJCF says itself what is free; received "free".')
    held = [joint for joint in root.iter("joint") if getattr(joint.find("parent"), "attrib", {}).get("link") == WORLD]
    if len(held) > 1 or any(joint.get("type") != "fixed" for joint in held):
        names = _some([f"{joint.get('name')} ({joint.get('type')})" for joint in held])
        raise ValueError(
            f'load: `base` is "free", and the root link of the URDF is "world", which does not move: only one link '
            f"that is fixed to it can be let loose; it carries the joints {names}. Rename the link."
        )


def _mujoco() -> Any:
    """The package, imported when a file is read."""
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        raise ImportError('load: files are read by the package mujoco: pip install "hhtjax[models]".') from None


def _text(source: Any):
    """What a file holds, and whether it is one."""
    if isinstance(source, str) and source.lstrip().startswith("<"):
        return source, False
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(f"load: `source` must be a path, or the text of a file; received {source!r}.")
    with open(source, encoding="utf-8") as file:
        return file.read(), True


def _simplified(root) -> list:
    """A URDF without shapes, whose files mostly are not there, and all links kept. What acts and is seen here only."""
    acting = []
    touching = [link.get("name") for link in root.iter("link") if link.find("collision") is not None]
    if touching:
        acting.append(("contact", f"collision shapes of {_some(touching)}"))
    for link in root.iter("link"):
        for tag in ("visual", "collision"):
            for shape in link.findall(tag):
                link.remove(shape)
    unphysical = [link.get("name") for link in root.iter("link") if not _is_physical(link)]
    if unphysical:
        acting.append(("unphysical", f"a moment of inertia above the sum of the others: {_some(unphysical)}"))
    for tag in ("transmission", "gazebo"):
        for element in root.findall(tag):
            root.remove(element)
    extension = root.find("mujoco")
    extension = ElementTree.SubElement(root, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.set("fusestatic", "false")
    if unphysical:
        compiler.set("balanceinertia", "true")
    return acting


def _is_physical(link) -> bool:
    """Whether its principal moments are those of a body; mujoco makes all alike where they are not."""
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return True
    xx, yy, zz, xy, xz, yz = (float(inertia.get(name, 0)) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return moments[2] <= moments[0] + moments[1]


def _some(names: list) -> str:
    """At most five of them."""
    return ", ".join(map(str, names[:5])) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _acting(m, limits: str | None, motors: bool) -> list:
    """What acts in a compiled model and is not in the equations here: (name, words)."""
    mujoco = _mujoco()
    found: list = []

    def add(name: str, what: str, here):
        if np.any(here):
            found.append((name, what))

    def names(kind: str, here) -> str:
        return _some([_name_of(m, kind, int(i)) for i in np.flatnonzero(here)])

    off = m.opt.disableflags
    if not off & (int(mujoco.mjtDisableBit.mjDSBL_CONTACT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)):
        add("contact", "shapes that can touch", m.npair > 0 or _can_touch(m))
    limited = (m.jnt_limited > 0) & (not _off(off, "LIMIT", "CONSTRAINT"))
    if limits is None:
        add("limits", f"ranges of {names('joint', limited)} (limits= takes them as stops or events)", limited)
    balls = limited & (m.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL))
    if limits in ("stop", "event"):
        add("limits", f'cones of the balls {names("joint", balls)}, which only limits="ignore" leaves out', balls)
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
    unseen = [i for i in rotors if not _turns(m, i)]
    add("actuator", f"rotors of motors that are on no hinge or slide ({len(unseen)})", unseen)
    massless = (m.body_mass == 0) & np.any(m.body_inertia != 0, axis=1)
    add("massless", f"inertia without mass of {names('body', massless)}", massless)
    if (_num_actuators(m) or motors) and not _off(off, "ACTUATION"):
        add("actuatorfrcrange", names("joint", m.jnt_actfrclimited), m.jnt_actfrclimited)
    if _num_actuators(m) and not _off(off, "ACTUATION"):
        strange = np.array([_strangeness(m, i) is not None for i in range(_num_actuators(m))])
        words = "; ".join(
            f"{_name_of(m, 'actuator', int(i))} ({_strangeness(m, int(i))})" for i in np.flatnonzero(strange)[:5]
        )
        add("actuator", words, strange)
    if m.neq and not _off(off, "EQUALITY", "CONSTRAINT"):
        here = (m.eq_active0 > 0) & ~np.isin(
            m.eq_type, [int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD), int(mujoco.mjtEq.mjEQ_JOINT)]
        )
        add("equality", f"constraints of other kinds ({int(np.sum(here))})", here)
    return found


def _off(flags: int, *names: str) -> bool:
    """Whether a part of the physics is switched off in the file."""
    mujoco = _mujoco()
    return any(flags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in names)


def _can_touch(m) -> bool:
    """Whether two shapes of different bodies may collide, by their bits and by whose parent is whose."""
    filtered = not _off(m.opt.disableflags, "FILTERPARENT")
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
    """A number for two bodies, whichever comes first."""
    return np.minimum(a, b) * 65536 + np.maximum(a, b)


def _num_actuators(m) -> int:
    return len(m.actuator_trntype)


def _on_joint(m, i: int) -> bool:
    """Whether an actuator is on a joint."""
    kinds = _mujoco().mjtTrn
    return int(m.actuator_trntype[i]) in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))


def _turns(m, i: int) -> bool:
    """Whether it is on a hinge or a slide."""
    kinds = _mujoco().mjtJoint
    one = int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)
    return _on_joint(m, i) and int(m.jnt_type[m.actuator_trnid[i, 0]]) in one


def _gear(m, i: int) -> float:
    """Of an actuator; one that has several outputs has as many rows of them."""
    rows = getattr(m, "actuator_outadr", None)
    return float(m.actuator_gear[i if rows is None else rows[i], 0])


def _strangeness(m, i: int) -> str | None:
    """Why an actuator is none of `Motor`'s kinds; None for one that is, or that is switched off."""
    mujoco = _mujoco()
    if m.opt.disableactuator & (1 << int(m.actuator_group[i])):
        return None
    if not _on_joint(m, i):
        return "not on a joint"
    if m.jnt_type[m.actuator_trnid[i, 0]] not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        return "on a ball or free joint"
    if m.actuator_dyntype[i] not in _activations():
        return f"with the activation {mujoco.mjtDyn(m.actuator_dyntype[i]).name.removeprefix('mjDYN_').lower()}"
    if m.actuator_gaintype[i] != int(mujoco.mjtGain.mjGAIN_FIXED):
        return "its gain is not fixed"
    if m.actuator_biastype[i] not in (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)):
        return "its bias is not affine"
    for name in ("actuator_damping", "actuator_dampingpoly", "actuator_delay"):
        values = getattr(m, name, None)
        if values is not None and np.any(values[i]):
            return name.replace("actuator_", "with ")
    return None


def _activations() -> dict:
    """Of the numbers that mujoco has for them, those that `Motor` has."""
    kinds = _mujoco().mjtDyn
    known = kinds.mjDYN_NONE, kinds.mjDYN_INTEGRATOR, kinds.mjDYN_FILTER, kinds.mjDYN_FILTEREXACT
    return dict(zip(map(int, known), (None, "integrator", "filter", "filter"), strict=True))


def _name_of(m, kind: str, i: int) -> str:
    """The name in the file, or kind and number where it has none, with as many "_" as make it its own."""
    known = getattr(m, "jnt" if kind == "joint" else kind)
    name = known(i).name
    if name:
        return name
    name, number = f"{kind}{i}", {"joint": m.njnt, "body": m.nbody, "site": m.nsite}.get(kind)
    taken = {known(k).name for k in range(_num_actuators(m) if number is None else number)} if kind != "tendon" else ()
    while name in taken:
        name += "_"
    return name


class _Reader:
    """The parts of a compiled model as those of a description."""

    def __init__(self, m):
        mujoco = _mujoco()
        self.m, self.mujoco = m, mujoco
        self.gravity = np.zeros(3) if _off(m.opt.disableflags, "GRAVITY") else np.array(m.opt.gravity)
        self.body_names = [WORLD] + [self.name("body", i) for i in range(1, m.nbody)]
        self.joint_names = [self.name("joint", i) for i in range(m.njnt)]

    def name(self, kind: str, i: int) -> str:
        """Of a part."""
        return _name_of(self.m, kind, i)

    def bodies(self) -> list[Body]:
        """Of all but the world."""
        m, found = self.m, []
        for i in range(1, m.nbody):
            first, count = m.body_jntadr[i], m.body_jntnum[i]
            joints = [self.joint(j) for j in range(first, first + count)]
            R = of_quaternion(m.body_iquat[i])
            inertia = R @ np.diag(m.body_inertia[i]) @ R.T if m.body_mass[i] else np.zeros((3, 3))
            found.append(
                Body(
                    self.body_names[i], self.body_names[m.body_parentid[i]], joints, float(m.body_mass[i]),
                    m.body_ipos[i], (inertia + inertia.T) / 2, m.body_pos[i], m.body_quat[i],
                )
            )  # fmt: skip
        return found

    def joint(self, j: int) -> Joint:
        """With springs, dampers and friction as far as they are switched on."""
        m, kinds, off = self.m, self.mujoco.mjtJoint, self.m.opt.disableflags
        dof, q = m.jnt_dofadr[j], m.jnt_qposadr[j]
        kind = {
            kinds.mjJNT_FREE: "free", kinds.mjJNT_BALL: "ball",
            kinds.mjJNT_SLIDE: "prismatic", kinds.mjJNT_HINGE: "revolute",
        }[kinds(m.jnt_type[j])]  # fmt: skip
        one = kind in ("revolute", "prismatic")
        ranged = one and m.jnt_limited[j] and not _off(off, "LIMIT", "CONSTRAINT")
        return Joint(
            kind,
            m.jnt_axis[j] if one else (0.0, 0.0, 1.0),
            (0.0, 0.0, 0.0) if kind == "free" else m.jnt_pos[j],
            self.joint_names[j],
            stiffness=0.0 if _off(off, "SPRING") else float(np.ravel(m.jnt_stiffness[j])[0]),
            rest=float(m.qpos_spring[q]) if one else 0.0,
            damping=0.0 if _off(off, "DAMPER") else float(m.dof_damping[dof]),
            armature=float(m.dof_armature[dof]) + (self.rotor(j) if one else 0.0),
            friction=0.0 if _off(off, "FRICTIONLOSS", "CONSTRAINT") else float(m.dof_frictionloss[dof]),
            range=tuple(m.jnt_range[j]) if ranged else None,
            reference=float(m.qpos0[q]) if one else 0.0,
        )

    def rotor(self, j: int) -> float:
        """The armature of the motors of a joint, as it sees it."""
        m = self.m
        values = getattr(m, "actuator_armature", np.zeros(_num_actuators(m)))
        here = [i for i in np.flatnonzero(values).tolist() if _on_joint(m, i) and m.actuator_trnid[i, 0] == j]
        return float(sum(values[i] * _gear(m, i) ** 2 for i in here))  # rotors turn, whether or not they are driven

    def actuators(self):
        """Numbers of those that are modelled, and switched on."""
        m = self.m
        if _off(m.opt.disableflags, "ACTUATION"):
            return []
        on = [i for i in range(_num_actuators(m)) if not m.opt.disableactuator & (1 << int(m.actuator_group[i]))]
        return [i for i in on if _strangeness(m, i) is None]

    def motors(self) -> list[Motor]:
        """F = gain u + b0 + b1 s + b2 sdot, as the kind of motor that it is."""
        return [self.motor(i) for i in self.actuators()]

    def motor(self, i: int) -> Motor:
        """A servo where its bias follows its gain."""
        m = self.m
        gain = float(m.actuator_gainprm[i, 0])
        affine = m.actuator_biastype[i] == int(self.mujoco.mjtBias.mjBIAS_AFFINE)
        b0, b1, b2 = (float(x) for x in m.actuator_biasprm[i, :3]) if affine else (0.0, 0.0, 0.0)
        kind, kp, kv = "torque", -b1, -b2
        if b1 and gain == -b1:
            kind, gain = "position", 1.0
        elif b2 and not b1 and gain == -b2:
            kind, gain = "velocity", 1.0
        clamps = not _off(m.opt.disableflags, "CLAMPCTRL")
        k = m.actuator_ctrladr[i] if hasattr(m, "actuator_ctrladr") else i
        activation = _activations()[int(m.actuator_dyntype[i])]
        return Motor(
            self.joint_names[m.actuator_trnid[i, 0]], kind, _gear(m, i), gain, kp, kv, b0,
            tuple(m.actuator_ctrlrange[k]) if m.actuator_ctrllimited[k] and clamps else None,
            tuple(m.actuator_forcerange[i]) if m.actuator_forcelimited[i] else None,
            self.name("actuator", i), activation,
            max(float(m.actuator_dynprm[i, 0]), SHORTEST) if activation == "filter" else None,
            tuple(m.actuator_actrange[i]) if activation and m.actuator_actlimited[i] else None,
        )  # fmt: skip

    def loops(self) -> list:
        """Of the kinds connect, weld and joint that are switched on."""
        m, kinds = self.m, self.mujoco.mjtEq
        if _off(m.opt.disableflags, "EQUALITY", "CONSTRAINT"):
            return []
        makers = {kinds.mjEQ_CONNECT: self.connect, kinds.mjEQ_WELD: self.weld, kinds.mjEQ_JOINT: self.couple}
        return [
            makers[kinds(m.eq_type[i])](i) for i in range(m.neq) if m.eq_active0[i] and kinds(m.eq_type[i]) in makers
        ]

    def ends(self, i: int) -> list:
        """Body, place and orientation of both sides, where they are sites; else bodies alone."""
        m = self.m
        both = []
        for k in (m.eq_obj1id[i], m.eq_obj2id[i]):
            if m.eq_objtype[i] == int(self.mujoco.mjtObj.mjOBJ_SITE):
                both.append((self.body_names[m.site_bodyid[k]], m.site_pos[k], of_quaternion(m.site_quat[k])))
            else:
                both.append((self.body_names[k], None, np.eye(3)))
        return both

    def connect(self, i: int) -> Connect:
        """Two points."""
        (a, x, _), (b, y, _) = self.ends(i)
        data = self.m.eq_data[i]
        return Connect(a, b, data[:3] if x is None else x, data[3:6] if y is None else y)

    def weld(self, i: int) -> Weld | Connect:
        """Two frames; without torque two points."""
        (a, x, R), (b, y, S) = self.ends(i)
        data = self.m.eq_data[i]
        if data[10] == 0:  # torquescale
            return Connect(a, b, data[3:6] if x is None else x, data[:3] if y is None else y)
        if x is None:
            return Weld(a, b, data[3:6], data[:3], of_quaternion(data[6:10]))
        return Weld(a, b, x, y, R @ S.T)

    def couple(self, i: int) -> Couple:
        """A polynomial."""
        m = self.m
        first, second = m.eq_obj1id[i], m.eq_obj2id[i]
        coefficients = np.trim_zeros(m.eq_data[i, :5], "b")
        origins = [float(m.qpos0[m.jnt_qposadr[j]]) if j >= 0 else 0.0 for j in (first, second)]
        second = None if second < 0 else self.joint_names[second]
        return Couple(self.joint_names[first], second, coefficients if len(coefficients) else [0.0], origins)

    def markers(self) -> list[Marker]:
        """The sites."""
        m, found = self.m, []
        for i in range(m.nsite):
            name = self.name("site", i)
            name = f"site {name}" if name in self.body_names else name
            found.append(Marker(name, self.body_names[m.site_bodyid[i]], m.site_pos[i], m.site_quat[i]))
        return found
