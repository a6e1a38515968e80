"""The same pinched cylinder in both simulators: held in both, with the same forces."""

import dataclasses
import math
import shutil
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import torch
import trimesh

from tests.pinch import QUICK, close, cylinder, pinch, quick_trial
from torchgrasp import Status, close_hand, load_hand
from torchgrasp.evaluation import PROTOCOLS, GraspTrial, Truth, pull_grasp
from torchgrasp.evaluation.trial import TrialDriver, TrialRun
from torchgrasp.foundation.errors import HandFileError, MendedInput
from torchgrasp.hand.urdf import read_urdf
from torchgrasp.sim import SceneSpec, open_scene
from torchgrasp.sim.sapien_bodies import CENTIMETRES
from torchgrasp.values.closing import ClosingOptions
from torchgrasp.values.planning import Contacts
from torchgrasp.values.specs import TrialSpec

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]
PULL = PROTOCOLS["dexgraspbench"].with_trial(mass=0.05)
ONCE = ClosingOptions(attempts=1)
PULL = dataclasses.replace(PULL, pull=dataclasses.replace(PULL.pull, seconds=0.2))


@pytest.fixture(autouse=True)
def both():
    pytest.importorskip("sapien")
    pytest.importorskip("mujoco")


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_simulators_hold_a_cylinder_with_equal_forces(name):
    spec = dataclasses.replace(QUICK, noise=False)
    there, here = (
        close(name, spec=dataclasses.replace(spec, simulator=s)) for s in ("sapien", "mujoco")
    )
    assert there.held and here.held
    assert np.abs(here.forces[-1] - there.forces[-1]).max() < 0.6
    assert np.abs(here.object_pose[-1] - there.object_pose[-1]).max() < 0.05
    assert set(here.joint_names) == set(there.joint_names)


def without_mass(folder, *links):
    """Barrett's hand, whose links of these names have no <inertial>."""
    folder = shutil.copytree(load_hand("barrett").urdf_path.parent, folder / "barrett")
    robot = ET.parse(folder / "hand.urdf")
    for name in links:
        (link,) = (x for x in robot.findall("link") if x.attrib["name"] == name)
        link.remove(link.find("inertial"))
    robot.write(folder / "hand.urdf")
    return load_hand(folder)


def opened(hand, simulator):
    """A scene with the hand."""
    ball = trimesh.creation.icosphere(radius=0.02)
    urdf = read_urdf(hand.urdf_path)
    joints = dict.fromkeys((joint.name for joint in urdf.movable), 0.5)
    tips = hand.tips.links
    spec = SceneSpec(urdf.path, np.eye(4), joints, hand.actuators, tips, ball, [ball], 0.1)
    return open_scene(spec, simulator)


def test_a_link_without_inertial_weighs_nothing_in_both_simulators(tmp_path):
    """SAPIEN gives it the density of water."""
    hand = without_mass(tmp_path, "f3_tip")
    scene = opened(hand, "sapien")
    there = {link.name: link for link in scene.hand.links}
    model = opened(hand, "mujoco").model
    for link in read_urdf(hand.urdf_path).links:
        mass = float(model.body(link.name).mass[0])
        inertia = max(model.body(link.name).inertia)
        assert there[link.name].mass == pytest.approx(mass, rel=1e-4, abs=2e-6)
        known = max(there[link.name].inertia) / CENTIMETRES**2
        assert known == pytest.approx(inertia, rel=1e-3, abs=2e-9)
    assert model.body("f3_tip").mass[0] == 0


def test_a_body_without_mass_is_told_by_sapien_and_refused_by_mujoco(tmp_path):
    hand = without_mass(tmp_path, "f3_tip", "f3_dist")
    with pytest.warns(MendedInput, match="links without mass .f3_dist.*give each an <inertial>"):
        opened(hand, "sapien")
    with pytest.raises(HandFileError, match="f3_dist"):
        opened(hand, "mujoco")


@pytest.mark.parametrize("pull", [10.0, 300.0])
def test_simulators_agree_on_a_pull(pull):
    hand, grasp = pinch("allegro")
    trial = GraspTrial(hand, grasp, Truth(cylinder()))
    protocol = dataclasses.replace(PULL, pull=dataclasses.replace(PULL.pull, acceleration=pull))
    there, here = (
        pull_grasp(trial, protocol.with_trial(simulator=s)) for s in ("sapien", "mujoco")
    )
    assert there.passed == here.passed == (pull < 100)
    assert here.force == pytest.approx(there.force, rel=0.05)


@pytest.mark.parametrize("simulator", ["sapien", "mujoco"])
def test_a_kept_run_goes_on_bitwise_as_the_run_itself_and_as_a_new_run_do(simulator):
    hand, grasp = pinch("barrett")
    spec = PULL.with_trial(simulator=simulator, closing="uncertainty", force=4.0).trial
    driver = TrialDriver(GraspTrial(hand, grasp, Truth(cylinder())), spec)
    first = closed(driver)
    new = closed(driver)
    reopen = first.keep()
    expected = pulled(first)
    assert np.abs(expected[-1] - expected[0]).max() > 1e-6  # the pull moves something
    for run in (new, reopen(), reopen()):
        assert np.array_equal(pulled(run), expected)


def closed(driver: TrialDriver) -> TrialRun:
    run = driver.open()
    for _ in run.close():
        pass
    return run


def pulled(run: TrialRun) -> np.ndarray:
    """Pull at the object; return its poses, the joints, and the forces that the noisy fingertips
    report.
    """
    run.scene.pull(np.array([0.2, 0.0, 0.3]))
    states = []
    for _ in range(10):
        run.step()
        felt = run.observation.tactile.forces.numpy()
        states.append(
            np.concatenate([x.ravel() for x in (run.scene.object_pose(), run.scene.joints(), felt)])
        )
    return np.array(states)


@pytest.mark.parametrize("simulator", ["sapien", "mujoco"])
def test_simulators_report_drives_that_are_too_weak(simulator):
    hand, grasp = pinch("allegro")
    drives = {name: drive._replace(effort=0.01) for name, drive in hand.actuators.items()}
    spec = dataclasses.replace(QUICK, simulator=simulator, options=ONCE)
    result = close_hand(grasp, dataclasses.replace(hand, actuators=drives), cylinder(), spec)
    assert (
        result.status is Status.TOO_WEAK and quick_trial("allegro", simulator).status is Status.OK
    )


@pytest.mark.parametrize("simulator", ["sapien", "mujoco"])
def test_simulators_never_hold_a_diverged_or_overlapping_trial(simulator, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hand, grasp = pinch("allegro")
    drives = {
        name: drive._replace(kp=1e12, kd=0.0, effort=1e30) for name, drive in hand.actuators.items()
    }
    wild = dataclasses.replace(hand, actuators=drives)
    protocol = PULL.with_trial(simulator=simulator)
    for closing, options in (("open_loop", None), ("uncertainty", ONCE)):
        spec = dataclasses.replace(QUICK, simulator=simulator, closing=closing, options=options)
        found = close_hand(grasp, wild, cylinder(), spec)
        assert (
            not found.held or float(found.forces.max()) < 50.0
        )  # PhysX's drives are stable at any stiffness
        result = pull_grasp(
            GraspTrial(wild, grasp, Truth(cylinder())),
            protocol.with_trial(closing=closing, options=options, kp=None),
        )
        assert result.status in (Status.UNSTABLE, Status.MOVED) or (
            result.passed and result.force < 50.0
        )
    deep = GraspTrial(hand, grasp, Truth(cylinder((0.04, 0.04))))
    assert pull_grasp(deep, protocol).status is Status.START_OVERLAP
    thrown = pull_grasp(
        deep, protocol.with_trial(overlap=1.0)
    )  # no overlap is refused: the object is thrown out
    assert thrown.status in (Status.EJECTED, Status.MOVED) and not thrown.passed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("simulator", ["sapien", "mujoco"])
def test_a_faceted_ball_stands_still(simulator):
    """Turned so that it stands on an edge of one of its 1280 facets, of which PhysX keeps 255."""
    hand, grasp = pinch("allegro")
    start = {k: float(v) for k, v in hand.expand(grasp.pregrasp[0]).items()}
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    ball.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.2, 0.1))
    ball.apply_translation([0.0, 0.0, -ball.bounds[0, 2]])
    above = np.eye(4) + 0.5 * np.eye(4, k=1) * [[0], [0], [1], [0]]
    scene = open_scene(
        SceneSpec(hand.urdf_path, above, start, hand.actuators, hand.tips.links, ball, [ball], 0.1),
        simulator,
    )
    for _ in range(500):
        scene.step()
    assert np.abs(scene.object_pose() - np.eye(4)).max() < 5e-3


def test_scene_mjcf_is_a_complete_model():
    """What is exported opens without this library, and weighs what hand and object weigh."""
    import mujoco

    from torchgrasp.sim.mujoco_scene import scene_mjcf

    hand, grasp = pinch("allegro")
    start = {k: float(v) for k, v in hand.expand(grasp.pregrasp[0]).items()}
    mesh = cylinder()
    where = grasp.obj_from_hand[0].numpy()
    setup = SceneSpec(
        hand.urdf_path, where, start, hand.actuators, hand.tips.links, mesh, [mesh], 0.1, patch=0.0
    )
    model = mujoco.MjModel.from_xml_string(scene_mjcf(setup))
    assert model.nu == len(hand.tree.joint_names) + 1
    assert model.body("torchgrasp_object").mass[0] == pytest.approx(0.1)
    assert set(model.geom_condim) == {3}
    assert model.actuator("joint_0").forcerange == pytest.approx([-0.7, 0.7])


@pytest.mark.parametrize("simulator", ["sapien", "mujoco"])
def test_simulators_let_no_bar_creep_in_the_hand(simulator):
    """Forces far inside the friction cones hold a slender bar without turning it, as Coulomb's law
    says.
    """
    hand, grasp = pinch("allegro")
    rows = {
        "joints": [
            0.1011,
            0.0616,
            1.1738,
            0.2043,
            -0.3042,
            1.1764,
            0.7055,
            0.6981,
            0.9696,
            0.8732,
            1.2688,
            0.1154,
        ],
        "pregrasp": [
            0.1895,
            0.0153,
            1.0919,
            0.0211,
            -0.4374,
            1.1155,
            0.6795,
            0.6495,
            0.72,
            1.0272,
            1.3282,
            0.3955,
        ],
        "approach": [0.0, 0.0, -1.0],
    }
    x = [-0.0342, 0.2479, -0.9682]
    y = [0.6474, -0.7325, -0.2104]
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, y, np.cross(x, y)], 1)
    pose[:3, 3] = [0.0099, -0.0111, 0.0992]
    points = [[-0.0147, -0.0796, 0.0087], [-0.0043, 0.0296, 0.0089], [0.0097, 0.0145, 0.0089]]
    normals = torch.tensor(
        [[[-0.351, -0.893, 0.282], [-0.932, 0.246, 0.267], [0.964, 0.056, 0.261]]]
    ).double()
    normals = normals / normals.norm(dim=-1, keepdim=True)
    contacts = Contacts(
        torch.tensor([points]).double(), normals, std_m=torch.full((1, 3), 0.001).double()
    )
    grasp = dataclasses.replace(
        grasp,
        contacts=contacts,
        obj_from_hand=torch.from_numpy(pose)[None],
        **{name: torch.tensor([row]).double() for name, row in rows.items()},
    )
    bar = trimesh.creation.box((0.0151, 0.1569, 0.012))
    bar.apply_transform(
        trimesh.transformations.rotation_matrix(-math.asin(0.111), [0, 0, 1], [0, 0, 0])
    )
    bar.apply_translation([0, 0, 0.006])
    spec = TrialSpec(mass=0.249, table_friction=0.2, simulator=simulator, push=(0.0, 0.0, -1.5))
    result = close_hand(
        grasp, hand, bar, spec
    )  # MuJoCo: 0.9 mm and 3.5 degrees; PhysX's TGS lets the bar fall
    assert result.held and result.slip.distance < 0.0013 and math.degrees(result.slip.angle) < 5
