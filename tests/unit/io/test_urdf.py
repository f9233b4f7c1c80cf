"""Robots from URDF files: masses, inertia, shapes, joints, and refusals."""

import importlib.util
import math
import warnings

import numpy as np
import pytest
import trimesh
from scipy.special import ellipk

import softwarp as sw
from softwarp.io.robots import RobotError

INERTIA = '<inertia ixx="{0}" iyy="{1}" izz="{2}" ixy="0" ixz="0" iyz="0"/>'
ARM = f"""<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0 0 -0.1" rpy="0 0 {math.pi / 2}"/><mass value="2"/>
      {INERTIA.format(0.01, 0.02, 0.015)}</inertial>
    <collision><origin xyz="0 0 -0.1"/><geometry><box size="0.02 0.03 0.2"/></geometry></collision>
    <visual><geometry><mesh filename="not_there.dae"/></geometry></visual>
  </link>
  <link name="cuff">
    <collision><origin xyz="0 0 0.01"/><geometry><sphere radius="0.02"/></geometry></collision>
  </link>
  <link name="lower">
    <inertial><mass value="0.5"/>{INERTIA.format(1e-3, 1e-3, 1e-3)}</inertial>
    <collision><geometry><cylinder radius="0.01" length="0.1"/></geometry></collision>
  </link>
  <link name="hand"><inertial><mass value="0.1"/>{INERTIA.format(1e-4, 1e-4, 1e-4)}</inertial></link>
  <link name="finger"><inertial><mass value="0.05"/>{INERTIA.format(1e-5, 1e-5, 1e-5)}</inertial></link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><origin xyz="0 0 1" rpy="0 {math.pi / 2} 0"/><axis xyz="0 2 0"/>
    <limit lower="0.5" upper="2" effort="30" velocity="4"/>
  </joint>
  <joint name="strap" type="fixed"><parent link="upper"/><child link="cuff"/><origin xyz="0 0 -0.05"/></joint>
  <joint name="elbow" type="continuous">
    <parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.2"/><axis xyz="0 1 0"/><dynamics damping="0.1"/>
  </joint>
  <joint name="wrist" type="fixed"><parent link="lower"/><child link="hand"/><origin xyz="0 0 -0.1"/></joint>
  <joint name="grip" type="prismatic">
    <parent link="hand"/><child link="finger"/><limit lower="-0.01" upper="0.02" effort="5" velocity="0.1"/>
  </joint>
</robot>"""


def written(tmp_path, text: str = ARM):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    return path


def test_arm(tmp_path):
    """By hand: turned inertia, kinds, limits about the start, poses down the chain, shapes of a link without mass."""
    robot = sw.read_urdf(written(tmp_path))
    builder = sw.ModelBuilder()
    added = robot.add_to(builder, positions={"shoulder": math.pi / 2})
    rigid = {name: builder.scene.rigids[handle] for name, handle in added.links.items()}
    assert rigid["base"].kinematic
    assert rigid["cuff"] is rigid["upper"]
    assert [part.shape.kind.name for part in rigid["upper"].shape.parts()] == ["BOX", "SPHERE"]
    np.testing.assert_allclose(rigid["upper"].shape.parts()[1].position, [0.0, 0.0, -0.04])
    assert (rigid["upper"].mass, rigid["lower"].mass, rigid["hand"].mass) == (2.0, 0.5, 0.1)
    np.testing.assert_allclose(rigid["upper"].centre, [0.0, 0.0, -0.1])
    np.testing.assert_allclose(rigid["upper"].inertia, np.diag([0.02, 0.01, 0.015]), atol=1e-12)
    # The shoulder's frame is turned by 90 degrees about y, and 90 more: the arm points up, from z = 1 m.
    np.testing.assert_allclose(rigid["lower"].pose[:3], [0.0, 0.0, 1.2], atol=1e-12)
    np.testing.assert_allclose(rigid["finger"].pose[:3], [0.0, 0.0, 1.3], atol=1e-12)
    joints = {name: builder.scene.joints[handle] for name, handle in added.joints.items()}
    assert {name: spec.kind for name, spec in joints.items()} == {
        "shoulder": "hinge",
        "elbow": "hinge",
        "wrist": "weld",
        "grip": "slider",
    }
    np.testing.assert_allclose(joints["shoulder"].limits, [0.5 - math.pi / 2, 2.0 - math.pi / 2])
    np.testing.assert_allclose(joints["shoulder"].axis, [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(joints["grip"].axis, [-1.0, 0.0, 0.0], atol=1e-12)
    assert joints["elbow"].limits == (-math.inf, math.inf)
    assert (joints["elbow"].control, joints["elbow"].stiffness, joints["elbow"].damping) == ("position", 0.0, 0.1)
    assert joints["grip"].limits == (-0.01, 0.02)
    assert added.start == {"shoulder": math.pi / 2, "elbow": 0.0, "grip": 0.0}
    sim = sw.Simulation(builder.finalize())
    sim.step()
    assert sim.status.tolist() == [sw.Status.OK]


def test_motors_have_the_limits_of_the_file(tmp_path):
    builder = sw.ModelBuilder()
    added = sw.read_urdf(written(tmp_path)).add_to(
        builder, control="position", stiffness=20.0, damping=1.0, prefix="a/"
    )
    shoulder, elbow = (builder.scene.joints[added.joints[name]] for name in ("shoulder", "elbow"))
    assert added.start["shoulder"] == 0.5  # the limit next to 0
    assert (shoulder.name, shoulder.max_force, shoulder.max_rate) == ("a/shoulder", 30.0, 4.0)
    assert (shoulder.stiffness, shoulder.damping, elbow.damping) == (20.0, 1.0, 1.1)


def test_pendulum(tmp_path):
    """Physical pendulum of 60 degrees: T = 4 / w0 K(sin 30), w0^2 = m g d / (I + m d^2); error O(h^2)."""
    text = f"""<robot name="pendulum"><link name="base"/><link name="bob">
      <inertial><origin xyz="0 0 -0.3"/><mass value="2"/>{INERTIA.format(0.01, 0.02, 0.02)}</inertial></link>
      <joint name="pivot" type="continuous"><parent link="base"/><child link="bob"/><axis xyz="0 1 0"/></joint>
      </robot>"""
    builder = sw.ModelBuilder()
    robot = sw.read_urdf(written(tmp_path, text)).add_to(builder, positions={"pivot": math.pi / 3})
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01, threads=1)
    angle = []
    for _ in range(300):
        sim.step()
        angle.append(math.pi / 3 + float(sim.joint_position[0, robot.joints["pivot"]]))
    q = np.array(angle)
    down = np.flatnonzero((q[:-1] > 0.0) & (q[1:] <= 0.0))
    period = float(np.diff(0.01 * (down + q[down] / (q[down] - q[down + 1]))).mean())
    exact = 4.0 * math.sqrt((0.02 + 2.0 * 0.3**2) / (2.0 * 9.81 * 0.3)) * ellipk(math.sin(math.pi / 6.0) ** 2)
    assert period == pytest.approx(exact, rel=2e-3)


def test_a_free_base_falls(tmp_path):
    text = f"""<robot name="stone"><link name="stone"><inertial><mass value="1"/>{INERTIA.format(1, 1, 1)}</inertial>
      </link></robot>"""
    builder = sw.ModelBuilder()
    sw.read_urdf(written(tmp_path, text)).add_to(builder, base="free", pose=(0.0, 0.0, 1.0))
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    for _ in range(10):
        sim.step()
    assert float(sim.body_pose[0, 0, 2]) == pytest.approx(1.0 - 9.81 * 0.01**2 * 55.0, rel=1e-9)


def test_meshes_are_found_scaled_and_may_be_hulls(tmp_path):
    """Relative to the file, in packages above it, and where a mesh is open only as its hull."""
    folder = tmp_path / "my_robot" / "meshes"
    folder.mkdir(parents=True)
    box = trimesh.creation.box((20.0, 30.0, 40.0))
    box.export(folder / "box.stl")
    trimesh.Trimesh(box.vertices, box.faces[1:]).export(folder / "open.stl")
    urdf = tmp_path / "my_robot" / "urdf"
    urdf.mkdir()

    def read(name, **options):
        text = f"""<robot name="r"><link name="a"><collision><geometry>
          <mesh filename="{name}" scale="0.001 0.001 0.002"/></geometry></collision></link></robot>"""
        return sw.read_urdf(written(urdf, text), **options).links["a"].shapes[0][0]

    for name in ("../meshes/box.stl", "package://my_robot/meshes/box.stl"):
        assert read(name).volume == pytest.approx(0.02 * 0.03 * 0.08)
    assert read("package://other/box.stl", packages={"other": folder}).volume == pytest.approx(0.02 * 0.03 * 0.08)
    with pytest.raises(sw.meshing.MeshError, match=r"link 'a': .*open.*meshes='hull'"):
        read("../meshes/open.stl")
    assert read("../meshes/open.stl", meshes="hull").volume == pytest.approx(0.02 * 0.03 * 0.08)
    with pytest.raises(FileNotFoundError, match=r"'package://none/box.stl' is not there; .*packages=\{'none'"):
        read("package://none/box.stl")


def two_links(kind: str, inner: str = "", child: str = "b") -> str:
    """A robot of two links and one joint."""
    joint = f'<joint name="j" type="{kind}"><parent link="a"/><child link="{child}"/>{inner}</joint>'
    return f'<robot><link name="a"/><link name="b"/>{joint}</robot>'


def one_link(inner: str) -> str:
    return f'<robot><link name="a">{inner}</link></robot>'


REFUSED = [
    ("<robot", "not an XML file"),
    ('<!DOCTYPE robot [<!ENTITY a "b">]><robot name="r">&a;</robot>', "document types and entities are not read"),
    ("<sdf/>", "outermost element is <sdf>"),
    ("<robot/>", "has no link; of a xacro file"),
    ("<robot><link/></robot>", "a link has no name"),
    ('<robot><link name="a"/><link name="a"/></robot>', "two links are called 'a'"),
    ('<robot><link name="a"/><link name="b"/></robot>', "link 'b' is not joined to the others"),
    (two_links("fixed", child="c"), "joint 'j': its child 'c' is no link"),
    (two_links("planar"), "joint 'j': softwarp has no 'planar' joints"),
    (two_links("fixed", "<mimic/>"), "joint 'j': its mimic element names no joint"),
    (
        two_links("continuous", '<mimic joint="k" multiplier="-2" offset="0.5"/>'),
        r"joint 'j': mimics 'k' \(position = -2 \* that of 'k' \+0.5\).*mimic='independent'",
    ),
    (two_links("revolute"), "revolute joints need a limit"),
    (two_links("revolute", '<limit lower="1" upper="-1"/>'), r"lower < upper, got \(1.0, -1.0\)"),
    (two_links("fixed", '<axis xyz="0 0 0"/>'), "axis must not be zero"),
    (two_links("fixed", '<origin xyz="0 nan 0"/>'), "xyz of <origin> must be 3 finite numbers"),
    (one_link('<inertial><mass value="x"/><inertia/></inertial>'), "value of <mass> must be a finite number"),
    (one_link("<inertial/>"), "link 'a': its inertial element needs mass and inertia"),
    (one_link("<collision/>"), "link 'a': a collision element needs one geometry"),
    (one_link("<collision><geometry><cone/></geometry></collision>"), "shapes are box, .* got 'cone'"),
]


GRIPPER = """<robot name="gripper"><link name="palm"/>{links}{joints}</robot>"""
FINGER = (
    """<link name="{0}"><inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"/></inertial></link>"""
)
SLIDE = """<joint name="{0}" type="prismatic"><parent link="palm"/><child link="{0}"/>
  <limit lower="-0.1" upper="0.1" effort="5" velocity="1"/>{1}</joint>"""


def gripper(mimic: str) -> str:
    """A palm with two fingers that slide, the first of which mimics."""
    joints = SLIDE.format("left", mimic) + SLIDE.format("right", "")
    return GRIPPER.format(links=FINGER.format("left") + FINGER.format("right"), joints=joints)


def test_mimicking_joints_can_be_commanded_along(tmp_path):
    """They start where they mimic, before or behind the other one in the file, and say how they follow it."""
    text = gripper('<mimic joint="right" multiplier="-0.5" offset="0.01"/>')
    robot = sw.read_urdf(written(tmp_path, text), mimic="independent")
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    added = robot.add_to(builder, positions={"right": 0.04}, control="position")
    assert added.start == {"left": pytest.approx(-0.01), "right": 0.04}
    sim = sw.Simulation(builder.finalize(precision="float64"), dt=0.01)
    for name in ("left", "right"):
        wanted = 0.06 if name == "right" else added.mimics["left"].position(0.06)
        sim.control.joint_target[0, added.joints[name]] = wanted - added.start[name]
    for _ in range(30):
        sim.step()
    left, right = (float(sim.body_pose[0, added.links[name], 0]) for name in ("left", "right"))
    assert right == pytest.approx(0.06, abs=1e-6)
    assert left == pytest.approx(-0.5 * right + 0.01, abs=1e-6)
    assert added.mimics["left"].joint == "right"


@pytest.mark.parametrize(
    ("mimic", "message"),
    [
        ('joint="rigth"', "joint 'left': mimics 'rigth', which is no joint; nearest: right"),
        ('joint="left"', "name 'left'"),
    ],
)
def test_mimicked_joints_have_to_be_there(mimic, message, tmp_path):
    with pytest.raises(RobotError, match=message):
        sw.read_urdf(written(tmp_path, gripper(f"<mimic {mimic}/>")), mimic="independent")


def test_visual_shapes_are_taken_on_request(tmp_path):
    """Links that have nothing else are told of; those with collision shapes are as they were."""
    ball = '<{0}><origin xyz="0 0 0.1"/><geometry><sphere radius="{1}"/></geometry></{0}>'
    both = ball.format("collision", 0.1) + ball.format("visual", 0.2)
    text = f"""<robot><link name="a">{both}</link><link name="b">{ball.format("visual", 0.3)}</link>
      <joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint></robot>"""
    with pytest.warns(UserWarning, match=r"1 links have visual and no collision elements \(b\).*shapes_of='visual'"):
        robot = sw.read_urdf(written(tmp_path, text))
    assert [len(link.shapes) for link in robot.links.values()] == [1, 0]
    assert robot.links["a"].shapes[0][0].radius == 0.1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = sw.read_urdf(written(tmp_path, text), shapes_of="visual")
    assert [link.shapes[0][0].radius for link in robot.links.values()] == [0.2, 0.3]
    np.testing.assert_allclose(robot.links["b"].shapes[0][1][:3, 3], [0.0, 0.0, 0.1])


COLLADA = """<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="f" count="12">0 0 0 10 0 0 0 10 0 0 0 10</float_array><technique_common>
<accessor source="#f" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><translate>5 0 0</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def collada_robot(folder):
    (folder / "part.dae").write_text(COLLADA)
    return written(folder, one_link('<collision><geometry><mesh filename="part.dae"/></geometry></collision>'))


def test_collada_meshes_have_their_unit_and_their_place(tmp_path):
    """A tetrahedron of 10 cm, 5 cm along x."""
    pytest.importorskip("collada")
    shape = sw.read_urdf(collada_robot(tmp_path)).links["a"].shapes[0][0]
    assert shape.volume == pytest.approx(0.1**3 / 6.0)
    surface = sw.meshing.as_surface(tmp_path / "part.dae")
    np.testing.assert_allclose(surface.bounds, [[0.05, 0.0, 0.0], [0.15, 0.1, 0.1]])
    for broken, message in ((COLLADA[:400], "not a valid .dae"), ("<!DOCTYPE a>" + COLLADA, "document types")):
        (tmp_path / "part.dae").write_text(broken)
        with pytest.raises(sw.meshing.MeshError, match=message):
            sw.meshing.as_surface(tmp_path / "part.dae")


def test_without_its_package_collada_is_refused(tmp_path, monkeypatch):
    """With the extra to install, and what needs no package."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "collada" else find(name, *more)
    )
    with pytest.raises(ImportError, match=r"link 'a': mesh 'part.dae': .*pip install 'softwarp\[dae\]'; or convert"):
        sw.read_urdf(collada_robot(tmp_path))


@pytest.mark.parametrize(("text", "message"), REFUSED)
def test_refusals(text, message, tmp_path):
    with pytest.raises(RobotError, match=message):
        sw.read_urdf(written(tmp_path, text))


def test_refusals_in_a_scene(tmp_path):
    robot = sw.read_urdf(written(tmp_path))
    with pytest.raises(RobotError, match="no joint 'elbo'; nearest: elbow"):
        robot.add_to(sw.ModelBuilder(), positions={"elbo": 1.0})
    with pytest.raises(RobotError, match=r"joint 'shoulder': position 3 lies outside its limits \[0.5, 2\]"):
        robot.add_to(sw.ModelBuilder(), positions={"shoulder": 3.0})
    with pytest.raises(RobotError, match="link 'base' moves and has no mass"):
        robot.add_to(sw.ModelBuilder(), base="free")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        sw.read_urdf(tmp_path / "none.urdf")
