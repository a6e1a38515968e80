"""The paper's closing against Eqs. (25)-(28) in NumPy, its end and its forces, and the baseline it
is compared with.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.make import real
from tests.point_fingers import NORMALS, TARGET, TOUCHING, observation, reference
from torchgrasp import ClosingReference, GraspController, load_hand
from torchgrasp.control import no_contact, observe
from torchgrasp.control.law import joint_step
from torchgrasp.control.paper.closings import PaperClosing, PositionClosing
from torchgrasp.control.paper.stability import load_stability
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rotation_from_vector
from torchgrasp.geometry.linalg import unit

HANDS = ("allegro", "barrett")


def printed_law(
    normal, f_cov, dev, compliance, goal, tips, force, reading, jacobian, posture, period
):
    """Eqs. (25)-(28) for the fingers of a hand, with the changes that docs/paper.md declares.

    These are: at least 0.01 mm^2 in Sigma_cov, 0.3 N in Sigma_fd, values of alpha, a speed limit
    for all fingers, and damped least squares in place of J^-1, whose null space follows the
    posture.
    """
    sigma_cov = np.maximum(np.abs(f_cov[:, None] * normal), 1e-8)  # the diagonals of Eq. (27)
    sigma_fd = dev[:, None] ** 2 * normal**2 + 0.3**2
    k_p = 1e-4 / sigma_cov
    c_f = (15.0 * compliance * min(dev**2 + 0.3**2))[:, None] / sigma_fd
    error = goal - tips
    share = np.exp(-0.5 * (error**2 / sigma_cov).sum(1))
    pull = force - -reading[:, None] * normal
    bracket = (1 - share)[:, None] * k_p * error + share[:, None] * c_f * pull
    bracket *= min(1.0, 0.04 / np.linalg.norm(bracket, axis=1).max())
    j = jacobian.reshape(-1, jacobian.shape[-1])
    inverse = j.T @ np.linalg.inv(j @ j.T + 1e-5 * np.eye(len(j)))
    if len(j) > j.shape[1]:
        inverse = np.linalg.inv(j.T @ j + 1e-5 * np.eye(j.shape[1])) @ j.T
    back = 4.0 * period * posture
    step = inverse @ (period * bracket.ravel()) + back - inverse @ (j @ back)
    return k_p, c_f, share, step * min(1.0, 0.05 / np.abs(step).max())


def drawn_plan(name: str, seed: int):
    """A plan whose contacts have other normals, variances and places than those of the shipped
    grasp, and its state.
    """
    g = torch.Generator().manual_seed(seed)
    hand = load_hand(name).to("cpu", torch.float64)
    grasp = load_shipped_grasp("jug", name)
    contacts = grasp.contacts
    normals = unit(contacts.normals + 0.4 * torch.randn(1, 3, 3, generator=g).double())
    variance = 0.01 * torch.rand(1, 3, generator=g).double()
    turn = torch.eye(4).double()
    turn[:3, :3] = rotation_from_vector(torch.randn(3, generator=g).double())
    contacts = dataclasses.replace(
        contacts,
        points=contacts.points @ turn[:3, :3].T,
        normals=normals @ turn[:3, :3].T,
        variance=variance,
    )
    grasp = dataclasses.replace(grasp, contacts=contacts, obj_from_hand=turn @ grasp.obj_from_hand)
    model = load_stability(hand)
    plan = ClosingReference.from_grasp(hand, grasp, 4.0, stability=model)
    middle = 0.5 * (hand.lower + hand.upper)
    joints = middle + 0.2 * (hand.upper - hand.lower) * (
        torch.rand(len(middle), generator=g).double() - 0.5
    )
    touched = dataclasses.replace(no_contact(), reading=3.0 * torch.rand(3, generator=g).double())
    seen = observe(hand, joints, touched)
    spread = (
        10.0 ** (-4 + 3 * torch.rand(3, 1, generator=g))
    ).double()  # errors from 0.1 to 100 mm
    goal = plan.contact_points(seen.tips) + spread * torch.randn(3, 3, generator=g).double()
    gains = dataclasses.replace(plan.gains, target=goal)
    return hand, grasp, model, dataclasses.replace(plan, gains=gains, pregrasp=joints), seen


@pytest.mark.parametrize("name", HANDS)
def test_eqs_25_to_28_of_the_paper_in_numpy(name):
    floored = 0
    for seed in range(8):
        hand, grasp, model, plan, seen = drawn_plan(name, seed)
        pose = grasp.obj_from_hand[0].double().numpy()
        normal = (
            grasp.contacts.normals[0].double().numpy() @ pose[:3, :3]
        )  # R f_w, in the hand's frame
        points = (grasp.contacts.points[0].double().numpy() - pose[:3, 3]) @ pose[:3, :3]
        f_cov = grasp.contacts.variance[0].numpy() * float(grasp.meta["unit_m"]) ** 2
        radius = hand.tips.radius.numpy()[:, None]
        dev = (
            model.preferred_forces(torch.tensor(points + radius * normal))
            .covariance.diagonal()
            .sqrt()
            .numpy()
        )
        at_contacts = hand.jacobian(grasp.joints.double(), torch.tensor(points)[None])[0].numpy()
        coupling = hand.actuated.coupling.numpy()
        firm = np.array([hand.actuators[joint].kp for joint in hand.tree.joint_names]) @ coupling**2
        yields = np.einsum("fch,fc->fh", at_contacts, normal) ** 2 / firm
        oracle = printed_law(
            normal,
            f_cov,
            dev,
            yields.sum(1),
            plan.gains.target.numpy(),
            seen.tips.numpy() - radius * normal,
            (plan.gains.desired_force.numpy() * normal).sum(1, keepdims=True) * normal,
            seen.tactile.reading.numpy(),
            seen.jacobian.numpy() @ coupling,
            (plan.joints - plan.pregrasp).numpy(),
            0.01,
        )
        law = PaperClosing(plan)
        law.lead = math.inf
        step = plan.pick(law(seen, 0.01)) - plan.pregrasp
        found = law.reference.gains.position_gain, law.reference.gains.force_gain, law.share, step
        for ours, theirs in zip(found, oracle, strict=True):
            np.testing.assert_allclose(ours.numpy(), theirs, rtol=1e-12, atol=1e-14)
        assert np.allclose(
            law.reference.gains.covariance.numpy(),
            [np.diag(1e-4 / k) for k in oracle[0]],
            rtol=1e-12,
        )
        floored += int((oracle[0] > 9999.9).sum())
    assert floored < 5  # nearly all entries are as printed


def test_the_papers_law_needs_the_variance_of_the_signed_distance():
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    unknown, foreign = (dict(grasp.meta) for _ in range(2))
    unknown.pop("unit_m")
    plan = ClosingReference.from_grasp(hand, dataclasses.replace(grasp, meta=unknown))
    assert plan.distance_variance is None
    GraspController(plan)
    with pytest.raises(BadArgument, match=r"closing: expected .*unit_m.*got 'paper' without f_cov"):
        GraspController(plan, "paper")
    with pytest.raises(BadArgument, match=r"unit_m.*a positive number.*got 'wide'"):
        ClosingReference.from_grasp(
            hand, dataclasses.replace(grasp, meta=unknown | {"unit_m": "wide"})
        )
    contacts = dataclasses.replace(grasp.contacts, variance=None)  # of another planner
    found = ClosingReference.from_grasp(
        hand, dataclasses.replace(grasp, contacts=contacts, meta=foreign)
    )
    assert torch.equal(found.distance_variance, contacts.std_m[0].double() ** 2)
    assert torch.equal(
        found.gains.covariance, ClosingReference.from_grasp(hand, grasp).gains.covariance
    )


def test_a_target_leads_a_blocked_joint_by_the_greatest_torque_of_its_drive():
    hand, _, _, plan, seen = drawn_plan("barrett", 0)
    plan = dataclasses.replace(
        plan, kp=100.0 * plan.kp, joints=plan.pregrasp
    )  # so firm that the bound is near
    effort = [hand.actuators[name].effort for name in hand.tree.joint_names]
    coupling = hand.actuated.coupling.numpy()
    most = [
        min(effort[j] / float(plan.kp[j]) / abs(row[k]) for j, row in enumerate(coupling) if row[k])
        for k in range(hand.dof)
    ]
    law = PaperClosing(plan)
    np.testing.assert_allclose(law.lead.numpy(), most, rtol=1e-12)
    for _ in range(60):
        law(seen, 0.01)  # the joints do not move
    ahead = (law.target - plan.pregrasp).abs().numpy()
    assert (ahead <= np.array(most) + 1e-12).all() and np.isclose(ahead, most).any()


def test_a_tick_turns_no_joint_by_more_than_a_twentieth_of_a_radian():
    step = joint_step(
        torch.eye(9).double().reshape(3, 3, 9), real([[9.0, 0, 0], [0, 1, 0], [0, 0, 0]]), 0.01
    )
    assert torch.allclose(
        step, 0.05 * torch.eye(9).double()[0] + 0.05 / 9 * torch.eye(9).double()[4]
    )


def ticks(law, seen, period: float, most: int = 40) -> int:
    """The number of ticks after which a closing is done; `seen` may depend on the tick."""
    for k in range(most):
        law(seen(k) if callable(seen) else seen, period)
        if law.done:
            return k + 1
    return most


def averaging(*averages: float):
    """An observation at the contacts whose average forces [N] are given for the first ticks, then
    the last of them.
    """
    there = observation(0.0, contact=TOUCHING)

    def at(k: int):
        average = torch.full((3,), averages[min(k, len(averages) - 1)]).double()
        return dataclasses.replace(
            there, tactile=dataclasses.replace(there.tactile, average=average)
        )

    return at


def test_the_papers_closing_ends_after_a_tenth_of_a_second_at_half_a_share_with_steady_forces():
    at = observation(0.0, contact=TOUCHING)
    assert (
        ticks(PaperClosing(reference()), at, 0.0334),
        ticks(PaperClosing(reference()), at, 0.0333),
    ) == (3, 4)
    half = 0.004 * math.sqrt(2 * math.log(2))  # where exp(-e^2 / (2 s^2)) is 0.5, along the normal
    near, far = (observation(x * half, contact=TOUCHING) for x in (0.999, 1.001))
    assert ticks(PaperClosing(reference()), near, 0.05) == 2
    assert ticks(PaperClosing(reference()), far, 0.05) == 40
    one = dataclasses.replace(at, tips=at.tips + real([[0.0], [0.0], [1.001 * half]]) * NORMALS)
    assert ticks(PaperClosing(reference()), one, 0.05) == 40  # one finger of three is not there
    two = torch.tensor([True, True, False])
    assert ticks(PaperClosing(reference()), observation(0.0, contact=two), 0.05) == 40
    # A change by NOISE from the forces at the last unsettled tick begins the time again.
    assert ticks(PaperClosing(reference()), averaging(0.0, 0.0999), 0.05) == 2
    assert ticks(PaperClosing(reference()), averaging(0.0, 0.1001), 0.05) == 4
    assert ticks(PaperClosing(reference()), averaging(0.0, -0.1001), 0.05) == 4
    for rise, period in (
        (0.1001, 0.05),
        (0.06, 0.02),
    ):  # the change since the time began counts, not that of a tick
        assert (
            ticks(PaperClosing(reference()), averaging(*(rise * k for k in range(40))), period)
            == 40
        )


def test_the_baseline_is_a_pi_controller_of_each_fingertip():
    """Sliding joints: J is the identity, and damped least squares divide by 1 + 1e-5."""
    law = PositionClosing(reference(), depth=0.0)
    error = -0.002 * NORMALS
    total = 0.0
    seen = observation(0.002)
    for k in range(1, 30):
        last = law.target
        law(seen, 0.01)
        velocity = 4.0 * error + 2.0 * k * 0.01 * error  # 4 1/s and 2 1/s^2
        step = (law.target - last).reshape(3, 3)
        assert torch.allclose(step, 0.01 * velocity / (1 + 1e-5), atol=1e-15)
        total += step
    assert torch.allclose(law.target.reshape(3, 3), total)
    fast = PositionClosing(reference(), depth=0.0)
    fast(observation(0.05), 0.01)
    assert torch.allclose(fast.target.reshape(3, 3).norm(dim=1), real([0.04 * 0.01] * 3), rtol=2e-5)


def test_the_baseline_stops_a_finger_at_half_a_newton_or_within_a_millimetre():
    law = PositionClosing(reference(), depth=0.0)
    law(observation(0.02, (0.4999, 0.5, -0.6)), 0.01)
    assert law.stopped.tolist() == [False, True, False]
    law(observation(0.02), 0.01)
    assert law.stopped.tolist() == [False, True, False]  # for good, though it feels nothing now
    for depth in (0.0, 0.02):
        for off, stops in ((0.00101, False), (0.00099, True), (-0.00099, True), (-0.00101, False)):
            law = PositionClosing(reference(), depth)
            law(observation(off - depth), 0.01)
            assert law.done is stops and bool(law.stopped.all()) is stops
            assert bool((law.target == 0).all()) is stops
    assert torch.equal(PositionClosing(reference()).aim, TARGET - 0.02 * NORMALS)
    assert torch.equal(
        GraspController(reference(), "position").closing.aim, TARGET - 0.02 * NORMALS
    )
