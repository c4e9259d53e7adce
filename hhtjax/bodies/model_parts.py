"""Converts a model that mujoco has compiled to a description: bodies, joints, motors, loops, markers."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from hhtjax.bodies.description import WORLD, Body, Connect, Couple, Joint, Marker, Motor, Weld, of_quaternion

SHORTEST = 1e-15  # s, mujoco's mjMINVAL, below which no filter is


def package() -> Any:
    """The package mujoco, imported when a file is read."""
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        raise ImportError('load: files are read by the package mujoco: pip install "hhtjax[models]".') from None


def is_off(flags: int, *names: str) -> bool:
    """Whether a part of the physics is switched off in the file."""
    mujoco = package()
    return any(flags & int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in names)


def num_actuators(m) -> int:
    """The number of actuators, by an attribute that every version of mujoco has."""
    return len(m.actuator_trntype)


def is_on_joint(m, i: int) -> bool:
    """Whether an actuator is on a joint."""
    kinds = package().mjtTrn
    return int(m.actuator_trntype[i]) in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))


def turns(m, i: int) -> bool:
    """Whether an actuator is on a hinge or a slide."""
    kinds = package().mjtJoint
    one = int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE)
    return is_on_joint(m, i) and int(m.jnt_type[m.actuator_trnid[i, 0]]) in one


def gear_of(m, i: int) -> float:
    """The gear of an actuator; one with several outputs has several rows of gears."""
    rows = getattr(m, "actuator_outadr", None)
    return float(m.actuator_gear[i if rows is None else rows[i], 0])


def strangeness(m, i: int) -> str | None:
    """Why an actuator is not one of the kinds of `Motor`; None if it is, or if it is switched off."""
    mujoco = package()
    if m.opt.disableactuator & (1 << int(m.actuator_group[i])):
        return None
    if not is_on_joint(m, i):
        return "not on a joint"
    if m.jnt_type[m.actuator_trnid[i, 0]] not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        return "on a ball or free joint"
    if m.actuator_dyntype[i] not in activations():
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


def activations() -> dict:
    """mujoco's numbers of the activations that `Motor` has, and their names."""
    kinds = package().mjtDyn
    known = kinds.mjDYN_NONE, kinds.mjDYN_INTEGRATOR, kinds.mjDYN_FILTER, kinds.mjDYN_FILTEREXACT
    return dict(zip(map(int, known), (None, "integrator", "filter", "filter"), strict=True))


def unique_names(given: list[str], made: list[str], others: Sequence[str] = ()) -> list[str]:
    """The names in the file; missing names are replaced by those in `made`, with _2, _3, ... if these are taken."""
    taken, names = {*given, *others}, []
    for name, other in zip(given, made, strict=True):
        number, found = 1, name or other
        while not name and found in taken:
            number += 1
            found = f"{other}_{number}"
        taken.add(found)
        names.append(found)
    return names


class Reader:
    """Converts the parts of a compiled model to those of a description."""

    def __init__(self, m, given: dict):
        mujoco = package()
        self.m, self.mujoco, self.given = m, mujoco, given
        self.gravity = np.zeros(3) if is_off(m.opt.disableflags, "GRAVITY") else np.array(m.opt.gravity)
        inner = range(1, m.nbody)
        self.body_names = [WORLD, *unique_names([m.body(i).name for i in inner], [f"body{i}" for i in inner], [WORLD])]
        on = [self.body_names[i] for i in m.jnt_bodyid]
        self.joint_names = unique_names([m.jnt(j).name for j in range(m.njnt)], on)
        drives = range(num_actuators(m))
        actuators = unique_names([m.actuator(i).name for i in drives], [f"actuator{i}" for i in drives])
        sites = [m.site(i).name for i in range(m.nsite)]
        sites = [f"site {name}" if name in self.body_names else name for name in sites]
        self.site_names = unique_names(sites, [f"site{i}" for i in range(m.nsite)], self.body_names)
        tendons = unique_names([m.tendon(i).name for i in range(m.ntendon)], [f"tendon{i}" for i in range(m.ntendon)])
        self.names = {"body": self.body_names, "joint": self.joint_names, "actuator": actuators, "tendon": tendons}

    def bodies(self) -> list[Body]:
        """All bodies except the world."""
        m, found = self.m, []
        for i in range(1, m.nbody):
            first, count = m.body_jntadr[i], m.body_jntnum[i]
            joints = [self.joint(j) for j in range(first, first + count)]
            R, name = of_quaternion(m.body_iquat[i]), self.body_names[i]
            inertia = R @ np.diag(m.body_inertia[i]) @ R.T if m.body_mass[i] else np.zeros((3, 3))
            mass, com, inertia = self.given.get(name, (float(m.body_mass[i]), m.body_ipos[i], inertia))
            found.append(
                Body(
                    name, self.body_names[m.body_parentid[i]], joints, mass, com, (inertia + inertia.T) / 2,
                    m.body_pos[i], m.body_quat[i],
                )
            )  # fmt: skip
        return found

    def joint(self, j: int) -> Joint:
        """A joint, with its springs, dampers and friction unless they are switched off."""
        m, kinds, off = self.m, self.mujoco.mjtJoint, self.m.opt.disableflags
        dof, q = m.jnt_dofadr[j], m.jnt_qposadr[j]
        kind = {
            kinds.mjJNT_FREE: "free", kinds.mjJNT_BALL: "ball",
            kinds.mjJNT_SLIDE: "prismatic", kinds.mjJNT_HINGE: "revolute",
        }[kinds(m.jnt_type[j])]  # fmt: skip
        one = kind in ("revolute", "prismatic")
        ranged = one and m.jnt_limited[j] and not is_off(off, "LIMIT", "CONSTRAINT")
        return Joint(
            kind,
            m.jnt_axis[j] if one else (0.0, 0.0, 1.0),
            (0.0, 0.0, 0.0) if kind == "free" else m.jnt_pos[j],
            self.joint_names[j],
            stiffness=0.0 if is_off(off, "SPRING") else float(np.ravel(m.jnt_stiffness[j])[0]),
            rest=float(m.qpos_spring[q]) if one else 0.0,
            damping=0.0 if is_off(off, "DAMPER") else float(m.dof_damping[dof]),
            armature=float(m.dof_armature[dof]) + (self.rotor(j) if one else 0.0),
            friction=0.0 if is_off(off, "FRICTIONLOSS", "CONSTRAINT") else float(m.dof_frictionloss[dof]),
            range=tuple(m.jnt_range[j]) if ranged else None,
            reference=float(m.qpos0[q]) if one else 0.0,
        )

    def rotor(self, j: int) -> float:
        """The armature of the motors of a joint, reflected to the joint."""
        m = self.m
        values = getattr(m, "actuator_armature", np.zeros(num_actuators(m)))
        here = [i for i in np.flatnonzero(values).tolist() if is_on_joint(m, i) and m.actuator_trnid[i, 0] == j]
        return float(sum(values[i] * gear_of(m, i) ** 2 for i in here))  # rotors turn, whether or not they are driven

    def actuators(self):
        """The indices of the actuators that are modelled and switched on."""
        m = self.m
        if is_off(m.opt.disableflags, "ACTUATION"):
            return []
        on = [i for i in range(num_actuators(m)) if not m.opt.disableactuator & (1 << int(m.actuator_group[i]))]
        return [i for i in on if strangeness(m, i) is None]

    def motors(self) -> list[Motor]:
        """The motors, F = gain u + b0 + b1 s + b2 sdot, as the kind of `Motor` with this formula."""
        return [self.motor(i) for i in self.actuators()]

    def motor(self, i: int) -> Motor:
        """One motor: a servo if its bias follows from its gain."""
        m = self.m
        gain = float(m.actuator_gainprm[i, 0])
        affine = m.actuator_biastype[i] == int(self.mujoco.mjtBias.mjBIAS_AFFINE)
        b0, b1, b2 = (float(x) for x in m.actuator_biasprm[i, :3]) if affine else (0.0, 0.0, 0.0)
        kind, kp, kv = "torque", -b1, -b2
        if b1 and gain == -b1:
            kind, gain = "position", 1.0
        elif b2 and not b1 and gain == -b2:
            kind, gain = "velocity", 1.0
        clamps = not is_off(m.opt.disableflags, "CLAMPCTRL")
        k = m.actuator_ctrladr[i] if hasattr(m, "actuator_ctrladr") else i
        activation = activations()[int(m.actuator_dyntype[i])]
        return Motor(
            self.joint_names[m.actuator_trnid[i, 0]], kind, gear_of(m, i), gain, kp, kv, b0,
            tuple(m.actuator_ctrlrange[k]) if m.actuator_ctrllimited[k] and clamps else None,
            tuple(m.actuator_forcerange[i]) if m.actuator_forcelimited[i] else None,
            self.names["actuator"][i], activation,
            max(float(m.actuator_dynprm[i, 0]), SHORTEST) if activation == "filter" else None,
            tuple(m.actuator_actrange[i]) if activation and m.actuator_actlimited[i] else None,
        )  # fmt: skip

    def loops(self) -> list:
        """The equality constraints of the kinds connect, weld and joint that are switched on."""
        m, kinds = self.m, self.mujoco.mjtEq
        if is_off(m.opt.disableflags, "EQUALITY", "CONSTRAINT"):
            return []
        makers = {kinds.mjEQ_CONNECT: self.connect, kinds.mjEQ_WELD: self.weld, kinds.mjEQ_JOINT: self.couple}
        return [
            makers[kinds(m.eq_type[i])](i) for i in range(m.neq) if m.eq_active0[i] and kinds(m.eq_type[i]) in makers
        ]

    def ends(self, i: int) -> list:
        """Body, position and orientation of both sides if they are sites; otherwise only the bodies."""
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

    def weld(self, i: int) -> Connect:
        """A weld of two frames; a connection of two points if torquescale is 0, which leaves rotations free."""
        (a, x, R), (b, y, S) = self.ends(i)
        data = self.m.eq_data[i]
        if data[10] == 0:
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
        m = self.m
        places = [self.body_names[i] for i in m.site_bodyid]
        return [Marker(*values) for values in zip(self.site_names, places, m.site_pos, m.site_quat, strict=True)]
