"""The simulated scene against statics, rigid-body formulae and the hand's own kinematics."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from tests.laws.scenes import check_scene
from torchgrasp import load_hand
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.hand.hand import Actuator
from torchgrasp.sim.mujoco_scene import OBJECT
from torchgrasp.sim.sapien_bodies import (
    CENTIMETRES,
    open_world,
    place,
    rigid_body,
    surface_of,
)
from torchgrasp.sim.scene_spec import (
    APPROACH_JOINT,
    LIFT_JOINT,
    SHIFT_JOINTS,
    Body,
    SceneSpec,
    euler_from_rotation,
    mounted_urdf,
)
from torchgrasp.sim.simulated_hand import open_scene
from torchgrasp.sim.simulated_scene import TABLETOP


def test_euler_angles_rebuild_the_rotation():
    rotations = Rotation.random(200, random_state=0).as_matrix()
    level = [Rotation.from_euler("xyz", [0.3, s * math.pi / 2, 0.8]).as_matrix() for s in (1, -1)]
    for matrix in [*rotations, *level, np.eye(3), np.diag([1.0, -1.0, -1.0])]:
        again = Rotation.from_euler("xyz", euler_from_rotation(matrix)).as_matrix()
        assert np.abs(again - matrix).max() < 1e-7


def mounted(urdf_path, **options):
    ball = trimesh.creation.icosphere(radius=0.02)
    return mounted_urdf(SceneSpec(urdf_path, np.eye(4), {}, {}, (), ball, [ball], 0.1, **options))


def test_mounted_urdf_has_geometry_and_mount_joints_and_refuses_files_that_are_no_hand(tmp_path):
    path = load_hand("barrett").urdf_path
    assert APPROACH_JOINT not in mounted(path)
    text = mounted(path, approach=(0.0, 0.06, -0.08))
    assert LIFT_JOINT in text
    assert 'xyz="0 0.6 -0.8"' in text
    assert "<mimic" not in text
    assert "<visual" not in text
    assert text.count("<collision") > 5
    assert not any(name in mounted(path) for name in SHIFT_JOINTS)
    assert all(name in mounted(path, yields=0.02) for name in SHIFT_JOINTS)
    with pytest.raises(HandFileError):
        mounted(tmp_path / "none.urdf")
    (tmp_path / "two.urdf").write_text('<robot name="r"><link name="a"/><link name="b"/></robot>')
    with pytest.raises(HandFileError, match="one root link"):
        mounted(tmp_path / "two.urdf")


def simulated(test):
    """Run a test in both simulators."""
    both = [pytest.param(name, marks=pytest.mark.sim) for name in ("sapien", "mujoco")]
    return pytest.mark.filterwarnings("ignore")(pytest.mark.parametrize("simulator", both)(test))


def build(name, mesh, simulator="sapien", **options):
    """A scene with the hand half a metre above the object."""
    pytest.importorskip(simulator)
    hand = load_hand(name)
    joints = 0.5 * (hand.lower + hand.upper)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.3, -0.8, 1.1]).as_matrix()
    pose[:3, 3] = [0.05, -0.1, 0.6]
    start = {k: float(v) for k, v in hand.expand(joints).items()}
    args = (
        hand.urdf_path,
        pose,
        start,
        hand.actuators,
        hand.tips.links,
        mesh,
        [mesh.convex_hull],
        0.36,
    )
    return hand, joints, torch.from_numpy(pose), open_scene(SceneSpec(*args, **options), simulator)


def standing(radius=0.03, height=0.12):
    mesh = trimesh.creation.cylinder(radius=radius, height=height)
    mesh.apply_translation([0, 0, height / 2 + 0.2])
    return mesh


def support(scene):
    """Return the force [N] with which all contacts hold up the object."""
    if hasattr(scene, "data"):  # MuJoCo
        return float(scene.data.joint(OBJECT).qfrc_constraint[2])
    contacts = scene.system.get_contacts()
    impulse = sum(np.asarray(p.impulse) for c in contacts for p in c.points) / CENTIMETRES
    return abs(float(np.asarray(impulse)[2])) / scene.timestep


@simulated
@pytest.mark.parametrize("timestep", [1 / 240, 1 / 500])
def test_scene_supports_the_objects_weight(timestep, simulator):
    *_, scene = build("barrett", standing(), simulator, timestep=timestep)
    forces = []
    for _ in range(200):
        scene.step()
        forces.append(support(scene))
    assert np.mean(forces[100:]) == pytest.approx(0.36 * 9.81, rel=5e-3)
    assert np.abs(scene.object_pose() - np.eye(4)).max() < 1e-4


@simulated
def test_scene_object_has_the_inertia_of_its_mesh(simulator):
    radius = 0.03
    height = 0.12
    mass = 0.36
    mesh = standing(radius, height)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    *_, scene = build("barrett", mesh, simulator)
    if simulator == "sapien":
        inertia = scene.body.inertia / CENTIMETRES**2
        centre = np.asarray(scene.body.cmass_local_pose.p) / CENTIMETRES
        frame = scene.body.cmass_local_pose.to_transformation_matrix()[:3, :3]
    else:
        body = scene.model.body("torchgrasp_object")
        inertia = body.inertia
        centre = body.ipos
        frame = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
    across = mass * (3 * radius**2 + height**2) / 12
    along = mass * radius**2 / 2
    assert np.sort(inertia) == pytest.approx([along, across, across], rel=0.02)
    assert centre == pytest.approx(mesh.center_mass, abs=1e-6)
    assert frame @ np.diag(inertia) @ frame.T == pytest.approx(
        np.asarray(mesh.moment_inertia) * mass / mesh.volume, rel=1e-3, abs=1e-8
    )


@pytest.mark.promise("N13")
@simulated
@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_scene_obeys_check_scene(name, simulator):
    pytest.importorskip(simulator)
    check_scene(lambda spec: open_scene(spec, simulator), load_hand(name))


SLIDING = """<robot name="r"><link name="pal&lt;m">{body}</link>{fingers}</robot>"""
SLIDER = """<link name="t{k}">{body}</link>
  <joint name="j{k}" type="{kind}"><parent link="pal&lt;m"/><child link="t{k}"/>
  <origin xyz="0 0 {k}"/><axis xyz="{axis}"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
BODY = """<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  <collision><geometry><sphere radius="0.1"/></geometry></collision>"""


@simulated
def test_jacobian_of_sliding_joints_is_along_their_axes(tmp_path, simulator):
    pytest.importorskip(simulator)
    kinds = [("prismatic", "1 0 0"), ("prismatic", "0 0 1"), ("revolute", "0 1 0")]
    fingers = "".join(
        SLIDER.format(k=k, kind=d, axis=x, body=BODY) for k, (d, x) in enumerate(kinds, start=1)
    )
    (tmp_path / "hand.urdf").write_text(SLIDING.format(body=BODY, fingers=fingers))
    names = ("j1", "j2", "j3")
    mesh = standing()
    start = dict.fromkeys(names, 0.0)
    drives = dict.fromkeys(names, Actuator(1.0, 1.0, 1.0, 0.1))
    pose = np.eye(4)
    pose[0, 3] = 5.0
    urdf = tmp_path / "hand.urdf"
    scene = open_scene(
        SceneSpec(urdf, pose, start, drives, ("t1", "t2", "t3"), mesh, [mesh.convex_hull], 0.36),
        simulator,
    )
    scene.step()
    assert set(scene.joint_names) == set(names)
    points = scene.tip_poses()[:, :3, 3] + [0.0, 0.0, 0.5]
    found = scene.jacobian(points)[:, :, [scene.joint_names.index(n) for n in names]]
    expected = np.zeros((3, 3, 3))
    expected[0, :, 0] = [1, 0, 0]
    expected[1, :, 1] = [0, 0, 1]
    expected[2, :, 2] = [0.5, 0, 0]
    assert np.abs(found - expected).max() < 1e-3


@simulated
def test_scene_pulls_at_the_mass_centre_and_lifts_at_a_speed(simulator):
    mesh = standing()
    mesh.apply_translation([0.3, 0.0, 0.0])
    *_, scene = build("allegro", mesh, simulator, gravity=0.0, table=False)
    scene.pull(np.array([0.0, 0.072, 0.0]))
    for k in range(250):
        scene.lift(0.04 * (k + 1) * scene.timestep, 0.04)
        scene.step()
    moved = np.eye(4)
    moved[1, 3] = 0.5 * (0.072 / 0.36) * 0.5**2
    assert scene.object_pose() == pytest.approx(
        moved, abs=3e-4
    )  # turned nowhere, moved by F t^2 / 2 m
    assert scene.hand_pose()[2, 3] - 0.6 == pytest.approx(0.02, abs=3e-4)


@simulated
def test_skipped_steps_are_the_steps_that_are_watched(simulator):
    poses = []
    for skips in (False, True):
        *_, scene = build("allegro", standing(), simulator)
        scene.pull(np.array([0.05, 0.0, 0.0]))
        if skips:
            scene.skip(120)
        else:
            for _ in range(120):
                scene.step()
        poses.append(np.concatenate([scene.object_pose().ravel(), scene.joints()]))
    assert np.array_equal(*poses)
    assert not np.array_equal(poses[0][:16].reshape(4, 4), np.eye(4))


@simulated
def test_open_scene_refuses_joints_without_a_drive(simulator):
    pytest.importorskip(simulator)
    mesh = standing()
    hand = load_hand("barrett")
    setup = SceneSpec(
        hand.urdf_path, np.eye(4), {}, hand.actuators, hand.tips.links, mesh, [mesh], 0.1
    )
    with pytest.raises(BadArgument, match=r"no position or drive for .*spread"):
        open_scene(setup, simulator)
    with pytest.raises(BadArgument, match=r"simulator: expected .*got 'bullet'"):
        open_scene(setup, "bullet")


@simulated
def test_a_mount_without_an_approach_or_room_to_yield_refuses_both(simulator):
    *_, scene = build("barrett", standing(), simulator)
    with pytest.raises(BadArgument, match="no joint torchgrasp_approach"):
        scene.approach(0.05)
    with pytest.raises(BadArgument, match="no joint torchgrasp_shift_x"):
        scene.shift(np.zeros(3))


@simulated
def test_yielding_mount_shifts_and_lifts_the_hand(simulator):
    *_, world_from_hand, scene = build("barrett", standing(), simulator, yields=0.02)
    scene.shift(np.array([0.02, -0.01, 0.005]))
    scene.lift(0.05)
    for _ in range(1000):
        scene.step()
    moved = scene.hand_pose() - world_from_hand.numpy()
    assert moved[:3, 3] == pytest.approx([0.02, -0.01, 0.055], abs=1e-4)
    assert np.abs(moved[:3, :3]).max() < 1e-5


AWAY = np.array([math.cos(0.7), math.sin(0.7)])  # a general direction beyond a table's edge


def slab(beyond):
    """A flat block at a height of 0.2 m, whose mass centre is `beyond` [m] the edge at 0.3 m."""
    mesh = trimesh.creation.box((0.1, 0.06, 0.02))
    mesh.apply_translation([*(0.3 + beyond) * AWAY, 0.21])
    return mesh


@simulated
def test_a_block_falls_over_the_edge_if_its_mass_centre_is_beyond(simulator):
    for beyond, falls in ((-0.04, False), (-0.002, False), (0.002, True), (0.02, True)):
        *_, scene = build("barrett", slab(beyond), simulator, edge=(*AWAY, 0.3))
        for _ in range(400):
            scene.step()
        pose = scene.object_pose()
        if falls:
            assert pose[2, 3] < -0.2
        else:
            assert pose == pytest.approx(np.eye(4), abs=3e-3)


@simulated
def test_a_rocking_cylinder_comes_to_rest_on_a_table_with_an_edge(simulator):
    """As on one without an edge, it stands up in the end."""
    turn = trimesh.transformations.euler_matrix(0.15, 0.05, 0.0)
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.12)
    mesh.apply_transform(turn)
    mesh.apply_translation([0, 0, 0.2 - mesh.bounds[0, 2]])
    *_, scene = build("barrett", mesh, simulator, edge=(*AWAY, 0.1))
    for _ in range(1000):
        scene.step()
    assert (scene.object_pose()[:3, :3] @ turn[:3, 2])[2] == pytest.approx(1.0, abs=1e-3)


@simulated
def test_a_hand_beyond_the_edge_is_below_the_table_and_touches_nothing(simulator):
    """The table's top is above the hand, which is at x = 0.05 m."""
    for offset, touches in ((-0.3, False), (0.05, True)):
        mesh = standing()
        mesh.apply_translation([-1.0, 0.0, 0.5])
        *_, scene = build("barrett", mesh, simulator, edge=(1.0, 0.0, offset), gravity=0.0)
        assert (scene.penetration() > 1e-3) == touches
        if not touches:
            strays = [scene.step().stray[TABLETOP] for _ in range(20)]
            assert not any(strays)


@pytest.mark.parametrize("offset", [0.3, 0.29, -5.0, 50.0])
def test_a_table_with_an_edge_is_a_box_around_all_that_is_near(offset):
    mesh = slab(0.0)
    spec = SceneSpec("", np.eye(4), {}, {}, (), mesh, [mesh], 0.1, edge=(*AWAY, offset))
    ledge = spec.ledge
    assert ledge.axes.T @ ledge.axes == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(ledge.axes) == pytest.approx(1.0)
    near = np.random.default_rng(0).uniform(-0.45, 0.45, (4000, 3)) + mesh.bounds.mean(0)
    boxed = (np.abs((near - ledge.centre) @ ledge.axes) < ledge.half).all(1)
    assert np.array_equal(boxed, (near[:, 2] < 0.2) & (near[:, :2] @ AWAY < offset))
    assert offset > 1.0 or not boxed.all()
    with pytest.raises(BadArgument, match=r"edge: .*a vector of length 2"):
        dataclasses.replace(spec, edge=(0.0, 2.0, offset))


def test_frictions_that_no_pair_of_surfaces_has_are_refused():
    """With the mean of two surfaces a fingertip has twice its friction less that of the object."""
    mesh = slab(0.0)
    spec = SceneSpec("", np.eye(4), {}, {}, (), mesh, [mesh], 0.1, friction=0.3, table_friction=0.6)
    assert spec.body_friction == 0.6
    with pytest.raises(BadArgument, match=r"table_friction: .*at most 2 friction, 0.6, got 0.7"):
        dataclasses.replace(spec, table_friction=0.7)
    with pytest.raises(BadArgument, match=r"table_friction: .*got -0.1"):
        dataclasses.replace(spec, table_friction=-0.1)
    with pytest.raises(BadArgument, match=r"friction: expected a number >= 0, got -0.3"):
        dataclasses.replace(spec, friction=-0.3)


def test_only_vertices_behind_the_edge_are_moved_up_to_the_table():
    """A block that stands on the table has a hook that hangs down beyond the edge."""
    mesh = slab(0.0)
    hook = trimesh.creation.box((0.01, 0.01, 0.05))
    hook.apply_translation([*0.34 * AWAY, 0.19])
    bump = trimesh.creation.box((0.01, 0.01, 0.0104))
    bump.apply_translation([*0.27 * AWAY, 0.205])
    args = "", np.eye(4), {}, {}, (), mesh, [mesh, hook, bump], 0.1
    hulls = SceneSpec(*args, height=0.2, edge=(*AWAY, 0.3)).hulls[0]
    assert np.array_equal(hulls[1], hook.vertices)
    for found, part in ((hulls[0], mesh), (hulls[2], bump)):
        assert found[:, 2].min() == 0.2
        assert np.abs(found - part.vertices).max() < 3e-4
    assert SceneSpec(*args, height=0.2).hulls[0][1][:, 2].min() == 0.2


def depth_in_disc(centre, radius, rim, height):
    """The depth [m] of a ball in a disc with a convex `rim` (n, 2) [m]; its centre is beside it."""
    edges = np.roll(rim, -1, 0) - rim
    share = np.clip(((centre[:2] - rim) * edges).sum(1) / (edges**2).sum(1), 0, 1)
    beside = np.linalg.norm(rim + share[:, None] * edges - centre[:2], axis=1).min()
    return radius - math.hypot(beside, max(centre[2] - height, 0.0))


def test_a_fingertip_over_the_rim_of_a_disc_meets_it():
    """In metres PhysX finds no contact in six of these directions
    (findings/sapien-ball-sinks-into-a-disc-without-a-contact.sh)."""
    sapien = pytest.importorskip("sapien")
    radius = 0.012
    height = 0.012
    turns = 2 * np.pi * np.arange(10) / 10
    rim = 0.03 * np.stack([np.cos(turns), np.sin(turns)], 1)
    corners = np.concatenate([np.c_[rim, 0 * turns], np.c_[rim, 0 * turns + height]])
    disc = trimesh.convex.convex_hull(corners)
    system, scene = open_world(0.0, 1 / 500, False)
    place(scene, "disc", rigid_body(surface_of(0.8), Body(disc, [disc], 0.1), [corners], 0.0))
    ball = sapien.physx.PhysxRigidDynamicComponent()
    ball.attach(sapien.physx.PhysxCollisionShapeSphere(CENTIMETRES * radius, surface_of(0.8)))
    place(scene, "ball", ball)
    still = sapien.Pose()
    tried = 0
    for turn in 0.31 * np.arange(12):
        for away in np.arange(0.045, 0.037, -6e-5):
            centre = np.array([away * math.cos(turn), away * math.sin(turn), 0.016])
            for entity, pose in zip(
                scene.entities, (still, sapien.Pose(CENTIMETRES * centre)), strict=True
            ):
                entity.set_pose(pose)
                body = entity.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
                body.linear_velocity = body.angular_velocity = np.zeros(3)
            system.step()
            if 1e-4 < depth_in_disc(centre, radius, rim, height) < 1e-3:
                tried += 1
                assert any(contact.points for contact in system.get_contacts())
    assert tried > 100


def test_the_inertia_of_a_body_does_not_depend_on_the_density_of_its_mesh():
    """trimesh ignores the density of a cylinder in its moment of inertia
    (findings/trimesh-cylinder-of-water-turns-like-one-of-density-one.sh)."""
    box = trimesh.creation.box((0.03, 0.04, 0.05))
    can = trimesh.primitives.Cylinder(radius=0.03, height=0.1)
    for mesh in (box, can, can.to_mesh()):
        light = Body(mesh, [mesh], 0.2).inertia
        mesh.density = 1000.0
        assert Body(mesh, [mesh], 0.2).inertia == pytest.approx(light, rel=1e-9)
        assert light.trace() > 1e-5
