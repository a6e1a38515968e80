"""Grasps that resist a task: the loads in the caller's frame, their proof, and what becomes of
weaker grasps.
"""

import json

import pytest
import torch

from tests.contacts.test_resist import by_highs
from tests.make import directions, load_hand, random_motion, real, same_bits
from torchgrasp import (
    ContactSpec,
    GraspTask,
    Status,
    explain_empty,
    load_grasps,
    load_object,
    plan_grasps,
)
from torchgrasp.app.report.run_data import grasp_columns, grasp_rows
from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.export import format_grasps
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.ik.attempts import assign
from torchgrasp.planner.many import estimate_shapes, plan_stacks
from torchgrasp.planner.objects import join_objects, pose_request
from torchgrasp.planner.ranking import predict
from torchgrasp.planner.request import Request
from torchgrasp.planner.rows import draw, find_candidates, with_costs
from torchgrasp.success import TaskWrenches
from torchgrasp.success.features import WEAK, measure_grasps
from torchgrasp.success.loads import strength_of
from torchgrasp.success.model import load_success_model
from torchgrasp.success.task import Conditions, loads_of

HAND = load_hand("allegro")
EFFORT = real([HAND.actuators[name].effort for name in HAND.joint_names])
VIEW = load_object("jug").view
FRAME = random_motion(7)
SPEC = ContactSpec(table=Plane.horizontal(0.0).moved(FRAME))
MASS = 0.2


@pytest.fixture(scope="module")
def poured():
    """Grasps that resist pouring, of a jug on a tilted table."""
    return plan_grasps(
        move(VIEW, FRAME), HAND, SPEC, 30, task=GraspTask(MASS), resist=("lift", "pour")
    )


def test_every_tilt_of_the_weight_is_resisted_and_weaker_grasps_say_so(poured):
    margin = poured.certificate.task_margin
    judged = (poured.status == Status.OK) | (poured.status == Status.NOT_RESISTED)
    assert torch.equal(poured.status[judged] == Status.OK, margin[judged] >= 1)
    good = poured.executable
    assert 0 < len(good) < int(judged.sum())
    tilted = directions(300)
    tilted = rotate(FRAME, tilted[tilted[:, 2] < 0.5])  # at most 120 degrees from straight down
    for grasp in good[:3]:
        points = grasp.contacts.points[0]
        normals = grasp.contacts.normals[0]
        load = grasp.certificate.task_load[0]
        centre = points.mean(0) + offset(load)  # the object's, seen from that of the contacts
        for force in 9.81 * MASS * tilted[::20]:
            wrench = torch.cat([force, torch.linalg.cross(centre, force)])
            assert (
                by_highs(
                    points, normals, grasp.certificate.task_strength[0].numpy(), wrench.numpy()
                )
                >= 1 - 1e-9
            )


def offset(load):
    """The arm on which the force of a load has its torque; the part along the force does not
    matter.
    """
    return torch.linalg.cross(load[:3], load[3:]) / load[:3].square().sum()


def test_no_drive_gives_more_than_its_torque_for_the_strength_of_a_fingertip(poured):
    good = poured.executable
    obj_from_hand = good.obj_from_hand
    jacobian = HAND.jacobian(good.joints, apply(inverse(obj_from_hand), good.contacts.points))
    push = -good.certificate.task_strength[..., None] * rotate(
        inverse(obj_from_hand), good.contacts.normals
    )
    torque = torch.einsum("gfih,gfi->gfh", jacobian, push).abs()
    share = (torque / real([HAND.actuators[name].effort for name in HAND.joint_names])).amax(-1)
    assert float(share.max()) < 1 + 1e-9
    assert bool(((share > 1 - 1e-9) | (good.certificate.task_strength == 15)).all())


def test_the_proof_is_saved_exported_and_shown(poured, tmp_path):
    poured.save(tmp_path / "grasps.safetensors")
    assert same_bits(load_grasps(tmp_path / "grasps.safetensors"), poured)
    best = json.loads(format_grasps(HAND, poured[:1]))["grasps"][0]
    assert (
        best["task_margin"] == float(poured.certificate.task_margin[0])
        and len(best["task_forces"]) == 3
    )
    assert grasp_columns(poured)[-1] == "task margin"
    assert grasp_rows(poured, 1)[0][-1] == f"{best['task_margin']:.2f}"
    assert "pour" in poured.meta["resist"] and "0.2 kg" in poured.meta["resist"]


def test_wrenches_about_a_point_are_those_of_the_callers_frame():
    point = real([0.1, 0.2, 0.3])
    about = real([[1.0, 2.0, 3.0, 0.1, 0.2, 0.3]])
    for given in (point, None):
        (there,) = loads_of(
            TaskWrenches(about, given),
            1.0,
            apply(inverse(FRAME), point[None])[0],
            inverse(FRAME),
            True,
        )
        force, torque = rotate(FRAME, there.view(2, 3))
        foot = FRAME[:3, 3]  # the origin of the upright frame
        torch.testing.assert_close(force, about[0, :3])
        torch.testing.assert_close(torque, about[0, 3:] + torch.linalg.cross(point - foot, force))
    down = loads_of("lift", 1.0, torch.zeros(3).double(), inverse(FRAME), False)[0, :3]
    torch.testing.assert_close(
        rotate(FRAME, down[None])[0], real([0.0, 0.0, -9.81])
    )  # of the cloud, without a table
    with pytest.raises(BadArgument, match="wrenches"):
        TaskWrenches(torch.zeros(1, 6))
    with pytest.raises(BadArgument, match=r"resist: .*no load"):
        plan_grasps(VIEW, HAND, resist=())


def test_many_clouds_resist_alone_as_together():
    hand = load_hand("barrett")
    spec = ContactSpec(table=0.0)
    views = [VIEW, load_object("cylinder").view]
    alone = plan_grasps(views, hand, spec, 4, resist="lift")
    requests = [Request(view, hand, spec, 4, resist="lift") for view in views]
    stacked = plan_stacks(requests, estimate_shapes(requests, 0), torch.device("cpu"))
    for one, other in zip(alone, stacked, strict=True):
        assert torch.equal(one.status, other.status)
        shared = one.status == Status.OK
        torch.testing.assert_close(
            one.certificate.task_margin[shared], other.certificate.task_margin[shared]
        )


def test_a_load_that_is_too_great_is_named_and_given_up():
    heavy = TaskWrenches(real([[0.0, 0.0, -500.0, 0.0, 0.0, 0.0]]))
    told = explain_empty(VIEW, HAND, ContactSpec(table=0.0), 20, resist=heavy)
    assert told.best is not None and told.best.words == "without resist"
    assert (
        told.funnel.reason is Status.NOT_RESISTED
        and told.funnel.stages[0].lost[Status.NOT_RESISTED] > 0
    )


def could_resist(objects, contacts, owner, strength) -> list[bool]:
    """Whether contacts of these strengths [N] resist all loads of their cloud, by HiGHS."""
    found = list[bool]()
    for p, n, own, most in zip(
        contacts.points, contacts.normals, owner.tolist(), strength, strict=True
    ):
        loads = objects.loads[own].numpy()
        found.append(all(by_highs(p, n, most.numpy(), load) >= 1 for load in loads))
    return found


@pytest.fixture(scope="module")
def steered():
    """The plan of two clouds that must resist pushes, with the contact sets that the hand may try."""
    views = [VIEW, load_object("cylinder").view]
    requests = [Request(x, HAND, ContactSpec(table=0.0), 40, resist="push") for x in views]
    objects = join_objects([pose_request(x, HAND) for x in requests], torch.device("cpu"))
    sizes = [size.starts for size in objects.sizes if size.starts]
    plan, owner = next(draw(objects, sizes))
    told = {}
    found = find_candidates(
        objects, plan, owner, 1000, lambda stage, value, **_: told.update({stage: value})
    )
    return objects, (plan, owner), told["plan"], found


def test_the_hand_tries_the_contact_sets_that_resist_with_the_greatest_forces_and_the_plan_says_so_of_others(
    steered,
):
    objects, (plan, owner), told, found = steered
    rows = torch.nonzero(plan.status == Status.OK)[:, 0]
    strength = torch.full((len(rows), 3), 15.0)  # the greatest force of a finger
    resisting = torch.tensor(could_resist(objects, plan.contacts[rows], owner[rows], strength))
    assert 10 < int(resisting.sum()) < len(rows) - 10
    assert torch.equal(told.status[rows] == Status.OK, resisting)
    assert bool((told.status[rows[~resisting]] == Status.NOT_RESISTED).all())
    assert torch.equal(found.contacts.points, plan.contacts.points[rows[resisting]])


def turning(seeds, contacts, forces):
    """The torques (g, h) [N m] of the joints by forces at the contacts, by each finger (g, f, h)."""
    hand_from_obj = inverse(seeds.obj_from_hand)
    jacobian = HAND.jacobian(seeds.joints, apply(hand_from_obj, contacts.points))
    return torch.einsum("gfih,gfi->gfh", jacobian, rotate(hand_from_obj, forces))


def shares_of(found, seeds):
    """The share of its set's load that each posture carries, at most 1, by HiGHS."""
    contacts = assign(found.contacts, seeds)
    torque = turning(seeds, contacts, contacts.normals).abs()
    strength = (EFFORT / torque).amin(-1).clamp(max=15)
    points = contacts.points - contacts.points.mean(1, keepdim=True)
    loads = found.load[seeds.row]
    rows = zip(points, contacts.normals, strength.numpy(), loads.numpy(), strict=True)
    return real([by_highs(*row) for row in rows]).clamp(max=1)


def test_contact_sets_and_postures_that_resist_the_worst_load_come_first(steered):
    found = with_costs(steered[0], steered[-1])
    cost = found.cost
    margins = shares_of(found, found.seeds)
    of_sets = [margins[found.seeds.row == row] for row in range(len(cost))]
    assert all(bool((margin.diff() < 1e-9).all()) for margin in of_sets)
    good = torch.stack([margin[0] == 1 for margin in of_sets])
    assert 0 < int(good.sum()) < len(good)
    assert float(cost[good].max()) < float(cost[~good].min())


def test_of_postures_that_resist_the_nearest_is_tried_first_and_then_the_strongest(steered):
    before = steered[-1]
    share = shares_of(before, before.seeds)
    found = with_costs(steered[0], before)
    seeds = found.seeds
    contacts = assign(found.contacts, seeds)
    forces = least_friction_forces(contacts.points, contacts.normals, strongest=1.0)
    strength = (EFFORT / turning(seeds, contacts, forces).sum(1).abs()).amin(1).clamp(max=15)
    second = list[float]()
    others = list[float]()
    for row in range(len(found)):
        at = torch.nonzero(seeds.row == row)[:, 0]
        old = torch.nonzero(before.seeds.row == row)[:, 0]
        assert sorted(seeds.energy[at].tolist()) == sorted(before.seeds.energy[old].tolist())
        good = old[share[old] == 1]
        if len(good):
            assert torch.equal(seeds.joints[at[0]], before.seeds.joints[good[0]])
        if len(good) > 2:
            second.append(float(strength[at[1]]))
            others.append(float(strength[at[2 : len(good)]].mean()))
    assert len(second) > 5
    assert float(real(second).mean()) > 1.1 * float(real(others).mean())


def test_a_lift_is_less_likely_where_forces_with_all_friction_hardly_carry_the_weight():
    mass = 0.9
    spec = ContactSpec(table=0.0)
    lifted, floating = (
        pose_request(Request(VIEW, HAND, spec, 30, task=GraspTask(mass, lift=lift)), HAND)
        for lift in (True, False)
    )
    grasps = plan_grasps(VIEW, HAND, spec, 30, task=GraspTask(mass))
    grasps = move(grasps.executable, inverse(lifted.each[0].obj_from_upright))
    cloud = torch.zeros(len(grasps), dtype=torch.int64)
    centre = lifted.body.center.double()
    weight = real([0.0, 0.0, -9.81 * mass])
    load = torch.cat([weight, torch.linalg.cross(centre, weight)]).numpy()
    strength = strength_of(HAND, grasps, grasps.contacts, 15.0).double().numpy()
    rows = zip(
        grasps.contacts.points.double(), grasps.contacts.normals.double(), strength, strict=True
    )
    carried = real([by_highs(*row, load, spec.mean_friction) for row in rows])
    assert float(carried.min()) < 1 < float(carried.max())
    weak = (WEAK.enough / carried.clamp(WEAK.least, WEAK.enough)).log()
    expected = model_alone(lifted, grasps) - WEAK.slope * weak
    torch.testing.assert_close(predict(lifted, grasps, cloud)[0], expected)
    torch.testing.assert_close(predict(floating, grasps, cloud)[0], model_alone(floating, grasps))


def model_alone(objects, grasps):
    """The log-odds of the success model, which knows no statics."""
    task = objects.request.grasp_task
    conditions = Conditions.of(objects.spec.friction, task.mass)
    lifts = task.lifts(objects.spec.plane)
    features = measure_grasps(HAND, objects.body, grasps, conditions, task, lifts)
    return load_success_model().mean_log_odds(features, conditions.weights)


def test_contact_sets_that_carry_a_lifted_weight_come_first():
    mass = 0.9
    spec = ContactSpec(table=0.0)
    objects = pose_request(Request(VIEW, HAND, spec, 40, task=GraspTask(mass)), HAND)
    sizes = [size.starts for size in objects.sizes if size.starts]
    plan, owner = next(draw(objects, sizes))
    found = with_costs(objects, find_candidates(objects, plan, owner, 1000, lambda *_, **__: None))
    contacts = assign(found.contacts, found.seeds)
    strength = strength_of(HAND, found.seeds, contacts, 15.0).numpy()
    weight = real([0.0, 0.0, -9.81 * mass])
    load = torch.cat([weight, torch.linalg.cross(objects.body.center.double(), weight)]).numpy()
    rows = zip(contacts.points, contacts.normals, strength, strict=True)
    margins = real([by_highs(*row, load, spec.mean_friction) for row in rows])
    good = torch.stack([margins[found.seeds.row == row].max() >= 1 for row in range(len(found))])
    assert 0 < int(good.sum()) < len(good)
    assert float(found.cost[good].max()) < float(found.cost[~good].min())
