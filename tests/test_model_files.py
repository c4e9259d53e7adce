"""Mechanisms from MJCF and URDF: the equations of mujoco, every pitfall, and one list of what is not modelled."""

import importlib.util
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import hhtjax
from hhtjax import bodies
from hhtjax.bodies import model_file

pytestmark = pytest.mark.skipif(importlib.util.find_spec("mujoco") is None, reason="needs mujoco (extra models)")

# a tree with all kinds of joints, several on one body, anchors off the origin, springs, servos, an offset reference
TREE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option gravity="0.3 -0.5 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body name="base" pos="0.1 0.2 0.3" quat="0.9 0.1 -0.2 0.3">
      <freejoint name="floating"/>
      <inertial pos="0.05 -0.02 0.1" mass="3" fullinertia="0.2 0.25 0.3 0.01 0.02 -0.03"/>
      <body name="upper" pos="0.3 0 0.1" euler="0.3 -0.2 0.5">
        <joint name="swing" axis="0 1 0.2" pos="0.05 0.1 0" damping="0.4" stiffness="3" springref="0.2" ref="0.3" armature="0.07"/>
        <joint name="lift" type="slide" axis="0.1 0 1" pos="0.2 0 0" stiffness="50" damping="2"/>
        <inertial pos="0.1 0.05 0" mass="1.2" diaginertia="0.02 0.03 0.025"/>
        <body name="wrist" pos="0.2 0.1 0">
          <joint name="ball" type="ball" pos="-0.05 0 0.1" damping="0.3" stiffness="1.5"/>
          <geom type="box" size="0.1 0.05 0.02" pos="0.05 0.02 0" density="800"/>
          <site name="tool" pos="0.1 0 0.05" quat="0.7 0.7 0 0"/>
          <body name="pad" pos="0.1 0 0" euler="0.1 0.2 0.3"><geom type="sphere" size="0.05" mass="0.4"/></body>
        </body>
      </body>
    </body>
    <body name="pole" pos="1 0 0"><joint name="pole" axis="1 0 0"/><geom type="capsule" size="0.03" fromto="0 0 0 0 0 0.5" mass="0.7"/></body>
  </worldbody>
  <actuator>
    <motor joint="swing" gear="5"/>
    <position joint="lift" kp="300" kv="15" gear="2"/>
    <velocity joint="pole" kv="3" ctrlrange="-0.5 0.5"/>
    <general joint="pole" gainprm="4" biastype="affine" biasprm="0.5 -2 -0.3" forcerange="-3 3"/>
    <intvelocity joint="swing" kp="20" kv="1" actrange="-4 4"/>
    <general joint="lift" dyntype="filter" dynprm="0.2" gainprm="7" ctrlrange="-0.4 0.4"/>
    <position joint="pole" kp="9" timeconst="0.05" gear="2"/>
  </actuator>
</mujoco>
"""  # noqa: E501

ARM = "".join(
    f'<body name="link{i}" pos="{0.05 * (i % 2)} 0.02 {0.2 + 0.02 * i}" euler="{20 * i} {-15 * i} {10 * i}">'
    f'<joint name="joint{i}" axis="{i % 2} {(i + 1) % 2} 0.3" armature="0.1" damping="{0.2 + 0.1 * i}"/>'
    f'<inertial pos="0.01 {0.02 * i} 0.1" mass="{4 - 0.4 * i}" diaginertia="0.03 0.04 0.02"/>'
    for i in range(7)
)
ARM = f"<mujoco><worldbody>{ARM}{'</body>' * 7}</worldbody></mujoco>"


def state_of(robot, seed=0):
    """A random q, v, w of ours."""
    rng = np.random.default_rng(seed)
    tree = robot.model.tree
    _, unravel = ravel_pytree(robot.v0)

    def rotations(n):
        return jnp.stack([bodies.description.of_quaternion(x) for x in rng.normal(size=(n, 4))])

    if tree.balls:
        q = {}
        if "ball" in robot.q0:
            q["ball"] = rotations(tree.balls - tree.frees)
        if "free" in robot.q0:
            q["free"] = {"R": rotations(tree.frees), "x": jnp.asarray(rng.normal(size=(tree.frees, 3)))}
        if "joint" in robot.q0:
            q["joint"] = jnp.asarray(rng.normal(size=tree.scalars))
    else:
        q = jnp.asarray(rng.normal(size=tree.rates))
    return q, *(unravel(jnp.asarray(x)) for x in rng.normal(size=(2, tree.rates)))


def as_mujoco(m, robot, q):
    """qpos, and the places of its rates in ours."""
    import mujoco

    tree = robot.model.tree
    qpos, order = m.qpos0.copy(), np.zeros(m.nv, int)
    balls = frees = scalars = 0
    plain = tree.balls - tree.frees
    joint = q["joint"] if tree.balls and tree.scalars else q
    for j in range(m.njnt):
        a, d, kind = m.jnt_qposadr[j], m.jnt_dofadr[j], int(m.jnt_type[j])
        if kind == 0:
            order[d : d + 3] = np.arange(3) + 3 * (tree.balls + frees)
            order[d + 3 : d + 6] = np.arange(3) + 3 * (plain + frees)
            qpos[a : a + 3] = q["free"]["x"][frees]
            mujoco.mju_mat2Quat(qpos[a + 3 : a + 7], np.array(q["free"]["R"][frees]).ravel())
            frees += 1
        elif kind == 1:
            order[d : d + 3] = np.arange(3) + 3 * balls
            mujoco.mju_mat2Quat(qpos[a : a + 4], np.array(q["ball"][balls]).ravel())
            balls += 1
        else:
            order[d] = 3 * (tree.balls + tree.frees) + scalars
            qpos[a] = joint[scalars]
            scalars += 1
    return qpos, order


@pytest.mark.parametrize("text", [ARM, TREE], ids=["seven axes", "all kinds of joints"])
def test_equations_are_those_of_mujoco(text):
    """M, bias, forces, accelerations, rates of activations, places of bodies and sites."""
    import mujoco

    robot, m = bodies.load(text), mujoco.MjModel.from_xml_string(text)
    q, v, w = state_of(robot)
    qpos, order = as_mujoco(m, robot, q)
    data = mujoco.MjData(m)
    data.qpos[:], data.qvel[:] = qpos, np.asarray(ravel_pytree(v)[0])[order]
    data.ctrl[:] = np.random.default_rng(1).normal(size=m.nu)
    data.act[:] = np.random.default_rng(2).normal(size=m.na)
    mujoco.mj_forward(m, data)
    M = np.zeros((m.nv, m.nv))
    columns = np.eye(m.nv)
    for i in range(m.nv):
        mujoco.mj_mulM(m, data, M[i], columns[i])
    params = robot.params | ({"ctrl": jnp.asarray(data.ctrl)} if m.nu else {})
    found = jax.jit(partial(bodies.mass_matrix, robot))(q)[np.ix_(order, order)]
    still = jax.tree.map(jnp.zeros_like, w)
    bias = ravel_pytree(jax.jit(partial(bodies.inverse_dynamics, robot))(q, v, still))[0][order]
    z = jnp.asarray(data.act) if m.na else None
    force = ravel_pytree(bodies.forces(robot, q, v, 0.0, params, z))[0][order]
    close = partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12)
    close(found, M)
    close(bias, data.qfrc_bias)
    close(force, data.qfrc_passive + data.qfrc_actuator)
    acceleration = np.linalg.solve(found, force - bias)
    np.testing.assert_allclose(acceleration, data.qacc, rtol=0, atol=1e-12 * max(1.0, np.abs(data.qacc).max()))
    if m.na:
        assert len(robot.activations) == len(robot.z0) == m.na == 3
        close(robot.system.internal(q, v, z, 0.0, params), data.act_dot)
    frames = robot.frames(q)
    for i in range(1, m.nbody):
        close(frames[m.body(i).name].x, data.xpos[i])
    for i in range(m.nsite):
        close(frames[m.site(i).name].x, data.site_xpos[i])
        close(frames[m.site(i).name].R.ravel(), data.site_xmat[i])


ACTIVATED = """
<mujoco>
  <option timestep="1e-4" integrator="RK4"/>
  <worldbody><body><joint name="j" axis="0 1 0" damping="1" armature="0.3"/>
    <inertial pos="0.3 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>
  <actuator>
    <general joint="j" dyntype="integrator" gainprm="20" actlimited="true" actrange="-0.2 0.25"/>
    <motor joint="j" gear="3"/>
    <general joint="j" dyntype="filterexact" dynprm="0.02" gainprm="3" actearly="true"/>
  </actuator>
</mujoco>
"""


def test_activations_run_as_in_mujoco():
    """An integrator that reaches both ends of its range and leaves them at once; a filter; a motor without."""
    import mujoco

    def ctrl(t, xp):
        return xp.stack([xp.sin(3 * t), 0.1 * xp.cos(t), xp.cos(4 * t)])

    robot, m = bodies.load(ACTIVATED), mujoco.MjModel.from_xml_string(ACTIVATED)
    data, angles, states = mujoco.MjData(m), [], []
    for i in range(20000):
        data.ctrl[:] = ctrl((i + 0.5) * 1e-4, np)
        mujoco.mj_step(m, data)
        angles.append(float(data.qpos[0]))
        states.append(np.array(data.act))
    params = robot.params | {"ctrl": lambda t: ctrl(t, jnp)}
    run = hhtjax.simulate(robot.system, hhtjax.hht(), robot.q0, robot.v0, params, z0=robot.z0, dt=4e-3, num_steps=500)
    run.check()
    np.testing.assert_allclose(run.q[1:, 0], angles[39::40], atol=1e-3)
    np.testing.assert_allclose(run.z[1:], states[39::40], atol=3e-3)
    assert float(jnp.max(run.z[:, 0])) > 0.25


LOOPED = """
<mujoco>
  <worldbody>
    <body name="crank"><joint name="crank" axis="0 1 0"/><geom type="capsule" size="0.01" fromto="0 0 0 0.3 0 0" contype="0" conaffinity="0"/>
      <site name="pin1" pos="0.3 0 0"/>
      <body name="rod" pos="0.3 0 0"><joint name="rod" axis="0 1 0"/><geom type="capsule" size="0.01" fromto="0 0 0 0.6 0 0" contype="0" conaffinity="0"/>
        <site name="pin2" pos="0.6 0 0"/></body></body>
    <body name="slider" pos="0.9 0 0"><joint name="slider" type="slide" axis="1 0 0"/><geom type="box" size="0.05 0.05 0.05" contype="0" conaffinity="0"/>
      <site name="pin3"/></body>
    <body name="follower" pos="0 1 0"><joint name="follower" axis="0 1 0"/><geom type="sphere" size="0.05" pos="0.1 0 0" contype="0" conaffinity="0"/></body>
  </worldbody>
  <equality>
    <connect site1="pin2" site2="pin3"/>
    <joint joint1="follower" joint2="crank" polycoef="0.05 2 0 0 0"/>
    <connect body1="crank" body2="rod" anchor="0.3 0 0" active="false"/>
  </equality>
</mujoco>
"""  # noqa: E501


def test_loops_of_a_file():
    """A slider crank by sites, and gears; what is inactive is not there; rows that say nothing new neither."""
    robot = bodies.load(LOOPED)
    assert [row.kind for row in robot.model.loops] == ["connect", "couple"]
    assert len(robot.model.rows) == 3
    frames = robot.frames(robot.q0)
    np.testing.assert_allclose(frames["pin2"].x, frames["pin3"].x, atol=1e-12)
    bar = bodies.load(
        LOOPED.replace('<connect site1="pin2" site2="pin3"/>', '<connect body1="rod" body2="slider" anchor="0.6 0 0"/>')
    )
    np.testing.assert_allclose(bar.q0, robot.q0, atol=1e-12)
    weld = bodies.load(
        LOOPED.replace('<connect site1="pin2" site2="pin3"/>', '<weld body1="crank" body2="follower"/>')
        .replace('<joint joint1="follower" joint2="crank" polycoef="0.05 2 0 0 0"/>', "")
    )  # fmt: skip
    moved = weld.frames(weld.q0)
    np.testing.assert_allclose(moved["follower"].R, moved["crank"].R, atol=1e-12)


URDF = """
<robot name="arm">
  <link name="floor"/>
  <link name="base"><inertial><origin xyz="0 0 0.1"/><mass value="4"/><inertia ixx="0.1" iyy="0.1" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="package://nowhere/base.stl"/></geometry></collision></link>
  <link name="upper"><inertial><origin xyz="0.2 0 0" rpy="0.1 0.2 0.3"/><mass value="2"/><inertia ixx="0.01" iyy="0.05" izz="0.05" ixy="0.001" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/upper.stl"/></geometry></visual></link>
  <link name="flange"/>
  <joint name="mount" type="fixed"><parent link="floor"/><child link="base"/></joint>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.3" rpy="0 0 1.570796"/><axis xyz="0 1 0"/>
    <dynamics damping="0.7" friction="0.3"/><limit lower="-1" upper="2" effort="10" velocity="3"/></joint>
  <joint name="tip" type="fixed"><parent link="upper"/><child link="flange"/><origin xyz="0.4 0 0"/></joint>
</robot>
"""  # noqa: E501


def test_a_urdf_keeps_its_fixed_links_and_needs_no_meshes():
    robot = bodies.load(URDF, ignore=("contact",), limits="ignore")
    assert robot.joints == ("shoulder",)
    assert "flange" in robot.markers
    assert robot.unsupported == ("contact: collision shapes of base", "limits: ranges of shoulder")
    assert float(robot.params["damping"][0]) == 0.7
    assert float(robot.params["frictionloss"][0]) == 0.3
    np.testing.assert_allclose(robot.frames(jnp.zeros(1))["flange"].x, [0, 0.4, 0.3], atol=1e-6)
    root = URDF.replace('"floor"', '"world"')
    assert bodies.load(root, ignore=("contact",), limits="ignore", base="free").joints == ("base", "shoulder")
    with pytest.raises(ValueError, match=r"load: `base` is \"free\", and the root .*mount \(floating\). Rename"):
        bodies.load(root.replace('"mount" type="fixed"', '"mount" type="floating"'), base="free")
    floating = bodies.load(URDF, ignore=("contact",), limits="ignore", base="free")
    assert floating.bodies == ("base", "upper")
    assert set(floating.q0) == {"free", "joint"}
    payload = bodies.Body("payload", "flange", mass=1.5, inertia=(0.01, 0.01, 0.01))
    loaded = bodies.load(
        URDF, ignore=("contact", "actuatorfrcrange"), limits="ignore", more=[payload],
        joints={"shoulder": {"friction": 2.0}},
        motors=[bodies.Motor("shoulder", "position", kp=100.0)],
    )  # fmt: skip
    assert loaded.bodies == ("upper", "payload")
    assert float(loaded.params["frictionloss"][0]) == 2.0
    gained = bodies.mass_matrix(loaded, loaded.q0) - bodies.mass_matrix(robot, robot.q0)
    assert float(gained[0, 0]) == pytest.approx(1.5 * 0.4**2 + 0.01)


def in_world(more="", joint="", top=""):
    return (
        f'<mujoco>{top}<worldbody><body name="a"><joint name="j" {joint}/><geom size="0.1" contype="0" conaffinity="0"/>'  # noqa: E501
        f'<site name="s"/></body></worldbody>{more}</mujoco>'
    )


TOUCHING = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="a" pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""  # noqa: E501
NOT_MODELLED = {
    "contact": TOUCHING,
    "limits": in_world(joint='range="-10 10" limited="true"'),
    "tendon": in_world('<tendon><fixed stiffness="3"><joint joint="j" coef="1"/></fixed></tendon>'),
    "fluid": in_world(top='<option density="1.2"/>'),
    "gravcomp": in_world().replace('name="a"', 'name="a" gravcomp="1"'),
    "actuator": in_world('<actuator><motor site="s" gear="1 0 0 0 0 0"/></actuator>'),
    "actuator ": in_world('<actuator><muscle joint="j" lengthrange="0 1"/></actuator>'),
    "actuator  ": in_world('<actuator><damper joint="j" kv="1" ctrlrange="0 1"/></actuator>'),
    "actuatorfrcrange": in_world('<actuator><motor joint="j"/></actuator>', 'actuatorfrcrange="-1 1"'),
    "equality": in_world('<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon><equality><tendon tendon1="t"/></equality>'),  # noqa: E501
    "mocap": "<mujoco><worldbody><body mocap='true'/><body name='a'><joint/><geom size='.1' contype='0' conaffinity='0'/></body></worldbody></mujoco>",  # noqa: E501
}  # fmt: skip


@pytest.mark.parametrize("name", NOT_MODELLED)
def test_what_acts_and_is_not_modelled_is_refused_by_name(name):
    """And runs without it where it is ignored, and says so."""
    text, name = NOT_MODELLED[name], name.strip()
    with pytest.raises(NotImplementedError, match=rf"(?s)    {name}: .*ignore="):
        bodies.load(text.replace("\n", " "))
    robot = bodies.load(text, ignore=(name,))
    assert [words.split(":")[0] for words in robot.unsupported] == [name]


def test_all_of_it_is_told_at_once():
    text = in_world('<actuator><motor site="s" gear="1 0 0 0 0 0"/></actuator>', top='<option density="1.2"/>')
    with pytest.raises(NotImplementedError, match=r'(?s)fluid: .*actuator: .*ignore=\("fluid", "actuator",\)'):
        bodies.load(text)


def test_gravity_is_that_of_the_file_or_of_the_caller():
    moon = [0, 0, -1.62]
    off = '<option><flag gravity="disable"/></option>'
    for text, given, expected in (
        (in_world(), None, [0, 0, -9.81]),
        (in_world(top='<option gravity="1 0 0"/>'), None, [1, 0, 0]),
        (in_world(top='<option gravity="1 0 0"/>'), moon, moon),
        (in_world(top=off), None, [0, 0, 0]),
        (in_world(top=off), moon, moon),
    ):
        np.testing.assert_allclose(bodies.load(text, gravity=given).params["gravity"], expected)
    with pytest.raises(ValueError, match=r"load: `gravity` must be finite numbers of shape \(3,\); received -9.81"):
        bodies.load(in_world(), gravity=-9.81)


def test_what_is_switched_off_in_the_file_is_off():
    flags = '<option><flag gravity="disable" damper="disable" spring="disable" limit="disable" frictionloss="disable"/></option>'  # noqa: E501
    robot = bodies.load(
        in_world(joint='damping="1" stiffness="2" frictionloss="3" range="-1 1" limited="true"', top=flags)
    )
    assert all(float(jnp.max(jnp.abs(robot.params[name]))) == 0 for name in ("gravity", "damping", "stiffness"))
    assert robot.rubbing == ()


def test_unphysical_links_of_a_urdf_are_refused_by_name():
    text = URDF.replace('ixx="0.1" iyy="0.1" izz="0.05"', 'ixx="0.01" iyy="0.1" izz="0.3"')
    with pytest.raises(NotImplementedError, match=r"unphysical: .*base"):
        bodies.load(text, ignore=("contact",), limits="ignore")
    bodies.load(text, ignore=("contact", "unphysical"), limits="ignore", base="free")


def test_wrong_sources_and_options_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        bodies.load(tmp_path / "missing.xml")
    with pytest.raises(ValueError, match="not valid XML"):
        bodies.load("<mujoco>")
    with pytest.raises(ValueError, match="MJCF"):
        bodies.load("<sdf/>")
    with pytest.raises(TypeError, match="a path"):
        bodies.load(3)
    with pytest.raises(ValueError, match="mujoco cannot read"):
        bodies.load("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>")
    with pytest.raises(ValueError, match="`ignore` must be one of"):
        bodies.load(in_world(), ignore=("contacts",))
    with pytest.raises(ValueError, match="`joints` must be one of"):
        bodies.load(in_world(), joints={"k": {"friction": 1.0}})
    path = tmp_path / "model.xml"
    path.write_text(in_world(joint='damping="0.5"'))
    assert float(bodies.load(path).params["damping"][0]) == 0.5


def test_rotors_of_all_motors_count_and_gears_are_their_own():
    """Also where the motor is switched off, or ignored; behind an actuator of several outputs."""
    body = '<body name="{0}"><joint name="{0}" {1}/><geom size="0.1" contype="0" conaffinity="0"/></body>'
    world = body.format("b", 'type="ball"') + body.format("h", "")
    acts = '<orientation joint="b"/><motor name="m" joint="h" gear="7" armature="0.01"/>'
    off = "<option><flag actuation='disable'/></option>"
    for more in ("", off):
        text = f"<mujoco>{more}<worldbody>{world}</worldbody><actuator>{acts}</actuator></mujoco>"
        robot = bodies.load(text, ignore=("actuator",))
        assert float(robot.params["armature"][-1]) == pytest.approx(0.49)
        assert robot.motors == (() if more else ("m",))
    assert float(bodies.load(text.replace(off, ""), ignore=("actuator",)).params["gear"][0]) == 7


def test_what_a_caller_adds_acts_too():
    """A range that the file does not have; the effort of a URDF, where there are motors."""
    with pytest.raises(ValueError, match="give limits="):
        bodies.load(in_world(), joints={"j": {"range": (-1, 1)}})
    with pytest.raises(NotImplementedError, match=r"(?s)actuatorfrcrange: shoulder"):
        bodies.load(URDF, ignore=("contact",), limits="ignore", motors=[bodies.Motor("shoulder")])
    with pytest.raises(ValueError, match="is for URDF"):
        bodies.load(in_world(), base="free")


def test_parent_and_child_touch_where_the_filter_is_off():
    shapes = '<body name="b"><joint/><geom size="0.1"/></body>'
    text = f'<mujoco>{{}}<worldbody><body name="a"><joint/><geom size="0.1"/>{shapes}</body></worldbody></mujoco>'
    bodies.load(text.format(""))
    with pytest.raises(NotImplementedError, match="contact"):
        bodies.load(text.format('<option><flag filterparent="disable"/></option>'))


def test_thousands_of_shapes_that_cannot_touch_are_read_at_once(monkeypatch):
    """Of bodies side by side whose bits exclude each other; but for one more. Shapes are looked at once a body and
    kind, against all others together: pair by pair it was 8 million times."""
    shapes = '<geom size="0.1" pos="{0} 0 0" contype="1" conaffinity="0"/>' * 40
    many = "".join(f'<body name="b{i}"><joint/>{shapes.format(i)}</body>' for i in range(100))
    text = f"<mujoco><worldbody>{many}{{}}</worldbody></mujoco>"
    looks, pair = [], model_file._pair
    monkeypatch.setattr(model_file, "_pair", lambda a, b: looks.append(1) or pair(a, b))
    bodies.load(text.format(""))
    assert 0 < len(looks) <= 100
    with pytest.raises(NotImplementedError, match="contact"):
        bodies.load(text.format('<body><joint/><geom size="0.1" contype="0" conaffinity="1"/></body>'))


def test_an_inertia_without_mass_is_refused_by_name():
    massless = '<body name="b" pos="0.1 0 0"><inertial pos="0 0 0" mass="0" diaginertia="0.3 0.3 0.3"/></body></body>'
    text = in_world().replace("</body>", massless)
    with pytest.raises(NotImplementedError, match=r"massless: .*b"):
        bodies.load(text)


LINK = '<link name="{0}"><inertial><mass value="{1}"/><inertia ixx="{2}" iyy="{3}" izz="{3}" ixy="0" ixz="0" iyz="0"/></inertial></link>'  # noqa: E501


def two_links(second, more=""):
    """A URDF of two links that turn side by side; of the second its line in the file."""
    return (
        f'<robot name="r"><link name="base"/>{LINK.format("a", 1, 1, 1)}{second}'
        '<joint name="j" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>'
        '<joint name="k" type="continuous"><parent link="base"/><child link="b"/>'
        f'<origin xyz="0 1 0" rpy="0.1 0.2 0.3"/><axis xyz="0 0 1"/>{more}</joint></robot>'
    )


def test_a_mimic_is_a_couple():
    mimic = '<mimic joint="j" multiplier="2" offset="0.1"/>'
    robot = bodies.load(two_links(LINK.format("b", 1, 1, 1), mimic))
    assert [row.kind for row in robot.model.loops] == ["couple"]
    assert robot.unsupported == ()
    assert float(robot.q0[1]) == pytest.approx(0.1 + 2 * float(robot.q0[0]))
    unread = two_links(LINK.format("b", 1, 1, 1), mimic).replace('"base"', '"world"')
    unread = unread.replace('"k" type="continuous"', '"k" type="floating"')
    with pytest.raises(NotImplementedError, match="equality: mimic of k, which mujoco does not read"):
        bodies.load(unread)


def test_a_rod_of_a_urdf_and_links_without_mass():
    """What mujoco does not compile; it is read as it stands, or refused by name with a way out."""
    rod = LINK.format("b", 2, 0, 0.3)
    robot = bodies.load(two_links(rod))
    np.testing.assert_allclose(np.diag(bodies.mass_matrix(robot, robot.q0)), [1, 0.3])
    assert robot.unsupported == ()
    tilted = [rod, LINK.format("b", 2, 1e-9, 0.3)]  # mujoco compiles the other one
    tilted = [link.replace("<inertial>", '<inertial><origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/>') for link in tilted]
    robot, other = (bodies.load(two_links(link)) for link in tilted)
    masses = (bodies.mass_matrix(x, x.q0) for x in (robot, other))
    np.testing.assert_allclose(*masses, atol=1e-8)
    strange = two_links(LINK.format("b", 2, -0.1, 0.2))
    with pytest.raises(NotImplementedError, match="unphysical: moments of inertia that no body has: b"):
        bodies.load(strange)
    robot = bodies.load(strange, ignore=("unphysical",))
    np.testing.assert_allclose(np.diag(bodies.mass_matrix(robot, robot.q0)), [1, 0.1])
    point = two_links(LINK.format("b", 2, 0, 0))  # on its axis
    assert bodies.load(point, ignore=("massless",)).joints == ("j",)
    swung = two_links(  # on the axis of k at the start only
        '<link name="b"/>'
        + LINK.format("c", 1, 0, 0).replace("<inertial>", '<inertial><origin xyz="0 0 1"/>')
        + '<joint name="l" type="continuous"><parent link="b"/><child link="c"/><axis xyz="1 0 0"/></joint>'
    )
    assert bodies.load(swung).joints == ("j", "k", "l")
    turned = two_links(
        '<link name="b"/><link name="c"/>'
        + LINK.format("d", 1, 0, 0).replace("<inertial>", '<inertial><origin xyz="0 1 1"/>')
        + '<joint name="l" type="continuous"><parent link="b"/><child link="c"/><axis xyz="1 0 0"/></joint>'
        '<joint name="m" type="continuous"><parent link="c"/><child link="d"/><axis xyz="0 1 0"/></joint>'
    )
    with pytest.raises(ValueError, match="the joints 'k', 'm' of `bodies` can move without moving a mass"):
        bodies.load(turned)
    bodies.load(turned, joints={"m": {"armature": 1e-3}})
    empty = two_links('<link name="b"/>')
    with pytest.raises(
        NotImplementedError, match=r"massless: joints that move no mass or turn no inertia, and have .*: k"
    ):
        bodies.load(empty)
    assert bodies.load(empty, ignore=("massless",)).joints == ("j",)
    assert bodies.load(empty, joints={"k": {"armature": 0.1}}).joints == ("j", "k")
    assert bodies.load(empty, more=[bodies.Body("load", "b", mass=1.0, com=(0.1, 0, 0))]).joints == ("j", "k")


def test_names_made_for_what_has_none_are_unique():
    shape = '<geom size="0.1" contype="0" conaffinity="0"/>'
    text = (
        f'<mujoco><worldbody><body><joint/><joint axis="1 0 0"/>{shape}<site/><site name="site0"/></body>'
        f'<body name="body1"><joint name="body2"/>{shape}</body><body>{"<joint/>"}{shape}</body></worldbody>'
        '<actuator><motor joint="body2"/><motor name="actuator0" joint="body2"/></actuator></mujoco>'
    )
    robot = bodies.load(text)
    assert robot.bodies == ("body1_2", "body1", "body3")
    assert robot.joints == ("body1_2", "body1_2_2", "body2", "body3")
    assert robot.motors == ("actuator0_2", "actuator0")
    assert {"site0", "site0_2"} <= set(robot.markers)


def test_a_weld_that_lets_the_bodies_turn_is_a_connection_of_points():
    ties = '<equality><weld body1="a" body2="b" torquescale="{}" relpose="0.1 0.2 0.3 1 0 0 0" anchor="0.3 0 0"/></equality>'  # noqa: E501
    shape = '<freejoint/><geom size="0.1" contype="0" conaffinity="0"/>'
    text = f'<mujoco><worldbody><body name="a">{shape}</body><body name="b" pos="-0.1 0.2 0.3">{shape}</body></worldbody>{{}}</mujoco>'  # noqa: E501
    kinds = [bodies.load(text.format(ties.format(x))).model.loops[0].kind for x in (0, 0.5)]
    assert kinds == ["connect", "weld"]
    loose = bodies.load(text.format(ties.format(0)))
    frames = loose.frames(loose.q0)
    one = frames["a"].x + frames["a"].R @ jnp.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(one, frames["b"].x + frames["b"].R @ jnp.array([0.3, 0, 0]), atol=1e-10)


def test_ranges_are_ignored_or_used():
    text = in_world(joint='range="-10 10" limited="true"')
    assert bodies.load(text, limits="ignore").unsupported == bodies.load(text, ignore=("limits",)).unsupported
    assert bodies.load(text, limits="ignore").unsupported == ("limits: ranges of j",)
    with pytest.raises(ValueError, match="give one of them"):
        bodies.load(text, ignore=("limits",), limits="stop")
    ball = in_world(joint='type="ball" range="0 10" limited="true"')
    with pytest.raises(NotImplementedError, match=r'(?s)cones of the balls j, for which there is only limits="ignore"'):
        bodies.load(ball, limits="stop")
    bodies.load(ball, limits="ignore")
