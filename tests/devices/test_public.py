"""Every public function with every tensor on another device: the CPU's result there, or an error
that names it.
"""

from typing import Any

import pytest
import torch

from tests.arm.ur5e import ur5e
from tests.devices.conftest import at_home, same, sent
from tests.devices.elsewhere import DEVICE
from tests.make import see
from torchgrasp import (
    ClosingReference,
    ContactSpec,
    Distribution,
    GraspController,
    PointCloud,
    Region,
    certify,
    closing_gains,
    closure_probability,
    cloud_from_depth,
    encode,
    fit_mixture,
    fit_shape,
    hold_probability,
    load_mixture,
    load_object,
    merge_clouds,
    plan_contacts,
    plan_grasps,
    sample_configurations,
    solve_ik,
)
from torchgrasp.cloud import cut_object, estimate_normals, remove_outliers, voxel_downsample
from torchgrasp.cloud.check import remove_duplicates
from torchgrasp.cloud.prepare import clean_cloud, prepare_cloud
from torchgrasp.contacts import least_friction_forces
from torchgrasp.control import measure, no_contact, observe, squeeze
from torchgrasp.control.tactile import TipContact
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.ik import CollisionWorld, IKSolution, Obstacles, PostureLibrary, nearest_postures
from torchgrasp.ik.seeds import query_mixture
from torchgrasp.scene import estimate_occupancy
from torchgrasp.shape import extract_surface
from torchgrasp.testing import random_joints
from torchgrasp.values.planning import ContactPlan

SPEC = ContactSpec(table=0.0)
FRICTION = Distribution.between(0.3, 0.8)
CPU = torch.device("cpu")
VIEW = load_object("cylinder").view

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
CLOSE = torch.full((40, 40), 0.5)
LENS = torch.tensor([[50.0, 0, 20], [0, 50, 20], [0, 0, 1]])

CLOUDS = {
    "fit_shape": lambda cloud: fit_shape(cloud, table=0.0),
    "fit_shape, paper": lambda cloud: fit_shape(cloud, support="paper"),
    "fit_shape, a kernel": lambda cloud: fit_shape(cloud, kernel="matern52", budget=30),
    "fit_shape, no camera": lambda cloud: fit_shape(PointCloud(cloud.points), budget=30),
    "merge_clouds": lambda cloud: merge_clouds(
        [cloud, cloud], torch.eye(4).to(cloud.points).expand(2, 4, 4)
    ),
    "clean_cloud": clean_cloud,
    "remove_outliers": remove_outliers,
    "voxel_downsample": lambda cloud: voxel_downsample(cloud, 0.005),
    "estimate_normals": estimate_normals,
    "PointCloud.select": lambda cloud: cloud.select(torch.arange(5)),
    "remove_duplicates": remove_duplicates,
    "prepare_cloud": lambda cloud: prepare_cloud(cloud, torch.Generator().manual_seed(0)),
    "cut_object": lambda cloud: cut_object(cloud, UP.to(cloud.points)),
    "cloud_from_depth": lambda cloud: cloud_from_depth(
        CLOSE.to(cloud.points), LENS.to(cloud.points)
    ),
}


def without_forces(plan: ContactPlan) -> tuple[Any, ...]:
    """Return a plan without the coefficients of its forces: which of several balances is found
    depends on rounding.
    """
    return plan.contacts, plan.quality, plan.status


SHAPES = {
    "predict": lambda shape, x: shape.predict(x),
    "differentiate": lambda shape, x: shape.differentiate(x),
    "joint": lambda shape, x: shape.joint(x),
    "sample": lambda shape, x: shape.sample(x, 4, seed=0),
    "update": lambda shape, x: shape.update(x[:1], noise=0.001),
    "contains": lambda shape, x: shape.contains(x),
    "extract_surface": lambda shape, x: extract_surface(shape, 24),
    "plan_contacts": lambda shape, x: without_forces(plan_contacts(shape, SPEC, 6)),
    "plan_contacts, paper": lambda shape, x: without_forces(
        plan_contacts(shape, ContactSpec.paper(), 2)
    ),
    "plan_contacts, given starts": lambda shape, x: without_forces(
        plan_contacts(shape, SPEC, x[:12].reshape(4, 3, 3))
    ),
}
CONTACTS = {
    "certify": lambda contacts, shape: certify(contacts, SPEC),
    "closure_probability": lambda contacts, shape: closure_probability(shape, contacts, SPEC, 200),
    "encode": lambda contacts, shape: encode(contacts),
    "hold_probability": lambda contacts, shape: hold_probability(contacts, FRICTION, 0.002, 0.05),
    "least_friction_forces": lambda contacts, shape: least_friction_forces(
        contacts.points, contacts.normals
    ),
}
HANDS = {
    "fingertips": lambda hand, joints: hand.fingertips(joints),
    "tip_centres": lambda hand, joints: hand.tip_centres(joints),
    "jacobian": lambda hand, joints: hand.jacobian(joints),
    "link_poses": lambda hand, joints: hand.link_poses(joints),
    "sphere_centres": lambda hand, joints: hand.sphere_centres(joints),
    "self_clearance": lambda hand, joints: hand.self_clearance(joints),
    "expand_joints": lambda hand, joints: hand.expand_joints(joints),
    "check_joints": lambda hand, joints: hand.check_joints(joints),
    "sample_configurations": lambda hand, joints: sample_configurations(hand, 50),
}


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds(device, name):
    same(CLOUDS[name](sent(VIEW)), at_home(lambda: CLOUDS[name](VIEW)))


@pytest.mark.promise("N9")
@pytest.mark.parametrize("name", SHAPES)
def test_shapes(device, shape, name):
    x = VIEW.points[:36].double()
    same(SHAPES[name](sent(shape), sent(x)), at_home(lambda: SHAPES[name](shape, x)))


@pytest.mark.parametrize("name", CONTACTS)
def test_contacts(device, shape, grasps, name):
    contacts = grasps.contacts
    same(CONTACTS[name](sent(contacts), sent(shape)), CONTACTS[name](contacts, shape))


@pytest.mark.parametrize("name", HANDS)
def test_hands(device, hand, name):
    joints = random_joints(hand, 7, 0)
    same(HANDS[name](sent(hand), sent(joints)), HANDS[name](hand, joints))


def test_joints_of_another_device_than_the_hand_are_refused(device, hand):
    joints = random_joints(hand, 7, 0)
    for name in set(HANDS) - {"sample_configurations"}:
        for one, other in ((sent(hand), joints), (hand, sent(joints))):
            with pytest.raises(BadArgument, match="joints"):
                HANDS[name](one, other)


def test_hand_and_model_follow_the_contacts(device, hand, grasps):
    contacts = grasps.contacts[:1]
    mixture = load_mixture("barrett")
    library = PostureLibrary.of(hand, 300)

    def solve(contacts) -> IKSolution:
        return solve_ik(hand, contacts, mixture, CollisionWorld(table=0.0), library=library)

    same(solve(sent(contacts)), solve(contacts))
    same(query_mixture(hand, sent(contacts), mixture), query_mixture(hand, contacts, mixture))


def test_a_library_of_another_device_is_refused(device, hand, grasps):
    library = PostureLibrary.of(hand, 300)
    with pytest.raises(BadArgument, match="contacts"):
        nearest_postures(library, sent(grasps.contacts), CollisionWorld())
    found = nearest_postures(sent(library), sent(grasps.contacts), CollisionWorld(table=0.0))
    same(found, nearest_postures(library, grasps.contacts, CollisionWorld(table=0.0)))


def test_a_given_shape_decides_where_grasps_are(device, hand, shape):
    assert plan_grasps(VIEW, hand, SPEC, 1, shape=sent(shape)).joints.device == DEVICE
    assert plan_grasps(sent(VIEW), hand, SPEC, 1, shape=shape).joints.device == CPU


def test_what_is_asked_of_contacts_and_of_the_arm_is_judged_where_the_cloud_is(
    device, hand, few_postures
):
    asked = {"resist": ("lift", "push"), "keep": Region.rim(VIEW, 0.0, 0.9), "arm": ur5e(hand)}
    here = at_home(lambda: plan_grasps(VIEW, hand, SPEC, 2, **asked))
    there = plan_grasps(sent(VIEW), hand, SPEC, 2, **asked)
    assert there.arm.device == there.certificate.task_margin.device == DEVICE
    assert torch.equal(there.status.cpu(), here.status)
    torch.testing.assert_close(there.arm.cpu(), here.arm)
    torch.testing.assert_close(there.certificate.task_margin.cpu(), here.certificate.task_margin)


def test_single_precision_goes_in_and_double_comes_out(device, hand, few_postures):
    cloud = sent(VIEW.to(torch.float32))
    found = plan_grasps(cloud, hand, SPEC, 1)
    assert found.joints.dtype == torch.float64 and found.joints.device == DEVICE
    assert fit_shape(cloud).predict(cloud.points[:3]).distance.dtype == torch.float32


def test_a_scene_is_planned_where_it_is(device, hand, few_postures):
    scene = see((0.0, 0.0, 0.06, 0.1), (0.0, 0.1, 0.06, 0.1))
    there = sent(scene)
    occupancy = at_home(lambda: estimate_occupancy(scene, 1))
    same(estimate_occupancy(there, 1), occupancy)
    same(Obstacles.of(sent(occupancy)), at_home(lambda: Obstacles.of(occupancy)))
    assert plan_grasps(there.select(1), hand, starts=1).joints.device == DEVICE


def test_a_mixture_is_fitted_where_its_samples_are(device, hand):
    samples = sample_configurations(hand, 300)
    same(fit_mixture(sent(samples), 3, iterations=4), fit_mixture(samples, 3, iterations=4))


@pytest.mark.parametrize("name", ["energy", "joints", "modes"])
def test_a_mixture_answers_where_it_is(device, grasps, name):
    mixture = load_mixture("barrett")
    code = encode(grasps.contacts)
    if name == "energy":
        return same(sent(mixture).energy(sent(code)), mixture.energy(code))
    query = {"joints": lambda m, q: m.joints(q), "modes": lambda m, q: m.modes(q, 2)}[name]
    return same(query(sent(mixture), sent(code.q[0])), query(mixture, code.q[0]))


def test_closing_is_on_the_cpu_whatever_is_given(device, hand, grasps):
    expected = closing_gains(grasps[0], hand)
    for grasp, its_hand in (
        (sent(grasps[0]), hand),
        (grasps[0], sent(hand)),
        (sent(grasps[0]), sent(hand)),
    ):
        same(closing_gains(grasp, its_hand), expected, CPU)


def test_the_squeeze_follows_the_grasps(device, hand, grasps):
    same(squeeze(hand, sent(grasps)), squeeze(hand, grasps))


@pytest.mark.parametrize("closing", ["uncertainty", "fixed", "paper", "position", "open_loop"])
def test_a_controller_runs_on_the_cpu(device, hand, grasps, shape, closing):
    reference = sent(ClosingReference.from_grasp(hand, grasps[0]))
    controller = GraspController(reference, closing=closing)
    reference = controller.reference
    tactile = no_contact()
    point = reference.gains.target
    truth = TipContact(torch.ones(3).double(), -reference.normals, point, reference.normals)
    tactile = measure(tactile, truth, reference.normals, hand.tips.radius.double(), 0.02)
    observation = observe(hand, reference.pregrasp, tactile)
    assert controller.step(observation, 0.02).joints.device == CPU
    with pytest.raises(BadArgument, match="observation"):
        controller.step(sent(observation), 0.02)
    with pytest.raises(BadArgument, match="truth"):
        measure(tactile, sent(truth), reference.normals, hand.tips.radius.double(), 0.02)
    with pytest.raises(BadArgument, match="tactile"):
        observe(hand, reference.pregrasp, sent(tactile))


def test_saved_grasps_come_back_on_the_cpu(device, grasps, tmp_path):
    from torchgrasp import load_grasps

    sent(grasps).save(tmp_path / "grasps.safetensors")
    same(load_grasps(tmp_path / "grasps.safetensors"), grasps, CPU)
