"""A trial over several grasps: which grasp comes next, where the object then stands, and what the
result tells.
"""

import dataclasses
import math

import pytest
import torch

from tests.make import real
from tests.pinch import QUICK, cylinder, digest, pinch, quick_trial
from torchgrasp import Plane
from torchgrasp.control.regrasp import list_others, next_grasp
from torchgrasp.evaluation import (
    GraspTrial,
    Protocol,
    ProtocolResult,
    PullSpec,
    Truth,
    ViewScore,
    summarise,
)
from torchgrasp.evaluation.causes import tick_of
from torchgrasp.evaluation.lift import lift_grasp
from torchgrasp.evaluation.protocols import apply_error
from torchgrasp.evaluation.pull import run_protocol
from torchgrasp.evaluation.several_tries import _left_behind, lift_grasps
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.geometry.frames import apply, inverse, rigid, rotate, rotation_from_vector
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.values.closing import ClosingOptions
from torchgrasp.values.planning import Contacts, Grasps

TURNED = real([0.0, 0.0, 1.0])


def placed(degrees=0.0, x=0.0, y=0.0):
    """A displacement along the table."""
    return rigid(rotation_from_vector(math.radians(degrees) * TURNED), real([x, y, 0.0]))


def several(*poses) -> Grasps:
    """The pinch of the cylinder, displaced by each pose."""
    _, grasp = pinch("allegro")
    grasp = grasp[[0] * len(poses)]
    pose = torch.stack(poses)
    contacts = dataclasses.replace(
        grasp.contacts,
        points=apply(pose, grasp.contacts.points),
        normals=rotate(pose, grasp.contacts.normals),
    )
    approach = rotate(pose, grasp.approach[:, None])[:, 0]
    return dataclasses.replace(
        grasp, obj_from_hand=pose @ grasp.obj_from_hand, contacts=contacts, approach=approach
    )


def differs(grasps: Grasps, one: int, two: int) -> bool:
    """Oracle: whether two grasps differ in direction or contacts, finger by finger."""
    a = grasps[one]
    b = grasps[two]
    gaps = [
        math.dist(p, q)
        for p, q in zip(a.contacts.points[0].tolist(), b.contacts.points[0].tolist(), strict=True)
    ]
    cosine = float(a.approach[0] @ b.approach[0])
    return (
        sum(gaps) / len(gaps) > 0.015 or math.degrees(math.acos(max(-1.0, min(1.0, cosine)))) > 30
    )


def test_the_next_grasp_is_the_best_that_differs_from_all_tried():
    generator = torch.Generator().manual_seed(0)
    drawn = torch.rand(30, 3, generator=generator, dtype=torch.float64) * real([90.0, 0.03, 0.03])
    grasps = several(*(placed(*row) for row in drawn.tolist()))
    tried = [0]
    while len(others := list_others(grasps, tried)):
        assert others.tolist() == [
            k for k in range(30) if all(differs(grasps, k, other) for other in tried)
        ]
        assert next_grasp(grasps, tried) == others[0]
        tried.append(int(others[0]))
    assert 2 < len(tried) < 30


def rod_and_pinches(*places: float, scores: list[float]) -> tuple[Grasps, SignedDistanceField]:
    """A rod of 200 mm along x, and pinches of it at some places along x [m], ranked by their
    log-odds.
    """
    axes = [torch.arange(-30, 31), torch.arange(-8, 9), torch.arange(-8, 9)]
    nodes = 0.004 * torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).double()
    past = (nodes.abs() - real([0.1, 0.01, 0.01])).clamp_min(0.0).norm(dim=-1)
    inside = (nodes.abs() - real([0.1, 0.01, 0.01])).amax(-1).clamp_max(0.0)
    rod = SignedDistanceField(nodes[0, 0, 0], 0.004, past + inside)
    grasps = several(*[placed()] * len(places))
    points = real([[0.01, 0.01, 0], [-0.01, 0.01, 0], [0, -0.01, 0]])
    contacts = Contacts(
        torch.stack([points + real([x, 0.0, 0.0]) for x in places]),
        real([[0, 1, 0], [0, 1, 0], [0, -1, 0]]).expand(len(places), 3, 3).clone(),
    )
    meta = {**grasps.meta, "ranking": "success", "friction": "0.8"}
    return dataclasses.replace(grasps, contacts=contacts, score=real(scores), meta=meta), rod


def test_a_failure_speaks_for_a_centre_of_mass_on_the_other_side():
    scores = [1.0, 0.99, 0.98, 0.97, 0.96, 0.95]
    grasps, rod = rod_and_pinches(0.05, 0.03, 0.07, 0.0, -0.05, -0.09, scores=scores)
    assert next_grasp(grasps, [0], rod) == 4
    assert next_grasp(grasps, [4], rod) == 1  # nearer to the likely centres of mass than grasp 0
    assert (
        next_grasp(grasps, [0], None)
        == next_grasp(dataclasses.replace(grasps, meta={}), [0], rod)
        == 1
    )
    unknown = dataclasses.replace(
        grasps, known=torch.tensor([True, True, True, False, False, False])
    )
    assert next_grasp(unknown, [0], rod) in (1, 2)


def test_among_equally_likely_grasps_the_one_far_from_the_failed_contacts_is_next():
    grasps, rod = rod_and_pinches(0.0, 0.016, -0.016, -0.03, 0.06, scores=[1.0] * 5)
    still = dataclasses.replace(grasps, score=real([1.0, 1.0, 1.0, 1.0, -9.0]))
    assert next_grasp(still, [0], rod) == 3


@pytest.mark.parametrize(
    ("pose", "fresh"), [((29.0,), True), ((0.0, 0.014), False), ((0.0, 0.016), True)]
)
def test_a_grasp_is_another_by_its_contacts_or_its_direction(pose, fresh):
    grasps = several(placed(), placed(*pose))
    points = grasps.contacts.points[[0, 0]]
    assert list_others(grasps, [0]).tolist() == ([1] if fresh else [])
    still = dataclasses.replace(
        grasps, contacts=dataclasses.replace(grasps.contacts, points=points)
    )
    assert len(list_others(still, [0])) == 0  # less than 30 degrees at the same contacts


RIGID_ARM = ClosingOptions(palm_reach=0.0, stops=0, attempts=1)
MISSED = placed(0.0, 0.3)
STILL = dataclasses.replace(QUICK, noise=False, approach=0.05, options=RIGID_ARM)


def trial(*poses, **truth) -> GraspTrial:
    return GraspTrial(
        pinch("allegro")[0], several(*poses), Truth(cylinder(), [cylinder()], **truth), seed=2
    )


@pytest.mark.sim
def test_a_trial_of_a_single_grasp_is_the_same_to_the_last_bit():
    pytest.importorskip("sapien")
    one = trial(placed())
    ((_, found),) = lift_grasps(one, QUICK, tries=1)
    ((_, first),) = lift_grasps(
        dataclasses.replace(one, grasp=several(placed(), MISSED)), QUICK, tries=1
    )
    assert digest(found) == digest(first) == digest(lift_grasp(one, QUICK))


@pytest.mark.sim
@pytest.mark.parametrize("simulator", ["sapien", "mujoco"])
def test_a_hand_that_closed_beside_the_object_holds_it_with_the_second_grasp(simulator):
    pytest.importorskip(simulator)
    spec = dataclasses.replace(STILL, simulator=simulator)
    (_, missed), (row, held) = lift_grasps(trial(MISSED, placed()), spec)
    assert (missed.status, row, held.status) == (Status.NO_CONTACT, 1, Status.OK)
    away = torch.linalg.vector_norm(missed.hand_pose[-1, :3, 3] - missed.hand_pose[0, :3, 3])
    assert float(away) < 0.005  # it is back where it came from, and open
    assert float((missed.joints[-1] - missed.joints[0]).abs().max()) < 0.05


@pytest.mark.sim
def test_a_held_object_is_not_tried_again_and_the_last_try_ends_the_trial():
    pytest.importorskip("sapien")
    ((_, held),) = lift_grasps(trial(placed(), placed(90.0)), STILL)
    height = held.hand_pose[:, 2, 3] - held.hand_pose[tick_of(held, 2), 2, 3]
    assert held.held and float(height[-1]) > 0.095
    failed = run_protocol(
        trial(MISSED, placed(0.0, 0.35), placed()), Protocol("twice", STILL, tries=2)
    )
    assert (failed.passed, failed.tries, failed.status) == (False, 2, Status.NO_CONTACT)


@pytest.mark.sim
def test_the_next_try_finds_all_bodies_where_the_last_left_them():
    """The mesh moves as the object did, on its table; the hand keeps its error and follows what it
    has felt.
    """
    pytest.importorskip("sapien")
    aside = placed(3.0, 0.002)
    felt = placed(20.0, 0.01)
    result = quick_trial()
    first = trial(placed(), placed(90.0), error=aside)
    one, two = first.grasp.obj_from_hand
    fallen = rigid(rotation_from_vector(real([1.5, 0.2, 0.1])), real([0.02, 0.3, 0.04]))
    result = dataclasses.replace(
        result, object_pose=torch.cat([result.object_pose[:-1], fallen[None]])
    )
    truth = _left_behind(dataclasses.replace(first, grasp=first.grasp[0]), result, felt, two)
    expected = apply(fallen, torch.tensor(cylinder().vertices))
    for body in (truth.mesh, *truth.parts):
        assert torch.allclose(torch.tensor(body.vertices), expected, atol=1e-12)
    assert truth.table.describe() == Plane.horizontal(0.0).describe()
    ending = Plane.horizontal(0.0).ending(real([0.01, 0, 0]), real([1.0, 0, 0]))
    planned = dataclasses.replace(first.grasp[0], meta={"table": ending.describe()})
    on_edge = _left_behind(dataclasses.replace(first, grasp=planned), result, felt, two)
    assert on_edge.table.describe() == ending.describe()
    off = apply_error(one, aside) @ inverse(
        one
    )  # of the hand's true from its believed pose, in the world
    expected = off @ (one @ felt @ inverse(one)) @ two
    assert torch.allclose(apply_error(two, truth.error), expected, atol=1e-12)


def test_protocols_of_pulls_have_no_second_grasp_and_summaries_count_them():
    with pytest.raises(BadArgument, match="tries of a lift"):
        Protocol("pull", QUICK, PullSpec(1.0, 1.0, 0.1, 1.0), tries=2)
    good = ProtocolResult(0, 0, True, Status.OK)
    tried = (
        good,
        dataclasses.replace(good, tries=3),
        dataclasses.replace(good, passed=False, tries=3),
    )
    assert summarise([ViewScore("jug", "view0", 9, 1.0, tried)])["tries"] == [1, 0, 1]
    assert summarise([ViewScore("jug", "view0", 9, 1.0, (good,))])["tries"] == [1]
