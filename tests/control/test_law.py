"""The closing law, Eqs. (25)-(28), against NumPy and closed forms; bounded and finite for any
state.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.make import directions
from tests.pinch import pinch
from torchgrasp import ClosingReference, closing_gains, load_hand
from torchgrasp.control.finger_forces import contacts_in_hand, desired_forces, tip_compliance
from torchgrasp.control.law import (
    FORCE_BANDWIDTH,
    FORCE_FLOOR,
    MAX_SPEED,
    MAX_STEP,
    POSITION_FLOOR,
    POSITION_RATE,
    blend,
    damped_inverse,
    force_covariance,
    force_gain,
    joint_step,
    position_gain,
    surface_covariance,
    tip_velocity,
)
from torchgrasp.control.paper.stability import load_stability
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument, IndefiniteCovariance
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.hand.drives import joint_stiffness


def draw(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def shipped(name):
    """A hand, its grasp of the jug, and the grasp's contacts in the hand's frame."""
    hand = load_hand(name)
    grasp = load_shipped_grasp("jug", name)
    points, normals = contacts_in_hand(grasp)
    return hand, grasp, points[0], normals[0]


def test_eq26_blend_is_the_gaussian_of_the_error():
    normals = directions(50)
    std = 0.02 * draw(50, seed=1).abs()
    covariance = surface_covariance(normals, std)
    error = 0.01 * draw(50, 3, seed=2)
    oracle = [
        math.exp(-0.5 * e @ np.linalg.inv(s) @ e)
        for e, s in zip(error.numpy(), covariance.numpy(), strict=True)
    ]
    share = blend(error, covariance)
    assert np.allclose(share.numpy(), oracle)
    assert ((share >= 0) & (share <= 1)).all()
    assert torch.equal(blend(torch.zeros(3), torch.eye(3)), torch.tensor(1.0))

    normal = torch.tensor([0.0, 0.0, 1.0])  # errors along it are tolerated more than across
    covariance = surface_covariance(normal, torch.tensor(0.015))
    assert blend(0.01 * normal, covariance) > 0.75
    assert blend(torch.tensor([0.01, 0.0, 0.0]), covariance) < 0.2
    with pytest.raises(IndefiniteCovariance):
        blend(torch.ones(3), torch.diag(torch.tensor([1.0, 1.0, -1.0])))


@pytest.mark.promise("N14")
def test_eq27_gain_is_inverse_to_the_variance_and_bounded_for_axis_normals():
    normals = torch.cat([torch.eye(3).double(), directions(20)])
    std = torch.linspace(0, 0.03, 23, dtype=torch.float64)
    gain = position_gain(surface_covariance(normals, std))
    oracle = (
        POSITION_RATE * POSITION_FLOOR**2 / (std[:, None] ** 2 * normals**2 + POSITION_FLOOR**2)
    )
    assert torch.allclose(gain, oracle)
    assert torch.isfinite(gain).all()
    assert gain.max() <= POSITION_RATE + 1e-9
    less, more = (
        position_gain(surface_covariance(normals, s * torch.ones(23).double()))
        for s in (0.002, 0.02)
    )
    assert (less >= more).all()


@pytest.mark.promise("N14")
def test_eq28_gain_is_inverse_to_the_force_variance_that_grows_with_the_force():
    covariance = torch.diag_embed(draw(7, 3).abs() + 0.1)
    assert torch.allclose(force_gain(covariance, 0.5), 0.5 / covariance.diagonal(dim1=-2, dim2=-1))
    alpha = torch.linspace(0.1, 1, 7).double()
    assert torch.allclose(force_gain(covariance, alpha)[3], alpha[3] / covariance[3].diagonal())
    normals = directions(3)
    forces = torch.tensor([3.0, 3.0, 6.0]).double()[:, None] * -normals
    along = torch.einsum("fi,fij,fj->f", normals, force_covariance(forces, normals), normals)
    assert along.tolist() == pytest.approx([0.09 + 0.09, 0.09 + 0.09, 0.09 + 0.36])
    least = torch.linalg.eigvalsh(force_covariance(forces, normals))[:, 0]
    assert least.tolist() == pytest.approx([0.09] * 3)


def test_eq25_is_the_papers_law_for_square_jacobians():
    """One finger of three joints a contact, small errors: J^-1 [(1-l) K (xd-xc) + l C (fd-fc)]."""
    jacobian = torch.zeros(3, 3, 9, dtype=torch.float64)
    for finger in range(3):
        jacobian[finger, :, 3 * finger : 3 * finger + 3] = 0.05 * (
            torch.eye(3) + 0.2 * draw(3, 3, seed=finger)
        )
    error = 1e-4 * draw(3, 3, seed=7)
    force_error = 0.01 * draw(3, 3, seed=8)
    share = torch.tensor([0.1, 0.5, 0.9]).double()
    k = 3 * draw(3, 3).abs()
    c = 0.02 * draw(3, 3, seed=9).abs()
    velocity = tip_velocity(error, force_error, share, k, c)
    step = joint_step(jacobian, velocity, 0.01, damping=1e-12)
    for finger in range(3):
        columns = slice(3 * finger, 3 * finger + 3)
        near = float(share[finger])
        square = jacobian[finger, :, columns].numpy()
        bracket = (1 - near) * (k * error)[finger].numpy() + near * (c * force_error)[
            finger
        ].numpy()
        assert np.allclose(step[columns], np.linalg.solve(square, 0.01 * bracket), rtol=1e-6)


@pytest.mark.parametrize("h", [4, 9, 12])
def test_eq25_damped_inverse_is_the_regularised_least_squares(h):
    jacobian = 0.05 * draw(6, 9, h)
    for j, found in zip(jacobian.numpy(), damped_inverse(jacobian).numpy(), strict=True):
        stacked = np.concatenate([j, math.sqrt(1e-5) * np.eye(h)])
        oracle = np.linalg.lstsq(
            stacked, np.concatenate([np.eye(9), np.zeros((h, 9))]), rcond=None
        )[0]
        assert np.allclose(found, oracle, atol=1e-8)


@pytest.mark.promise("I12")
@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-3, 1.0, 1e3])
def test_eq25_is_bounded_and_finite_for_any_state(scale):
    """States of fingers that nothing moves, singular ones, and gains from zero to almost infinite."""
    n = 4000
    jacobian = scale * draw(n, 3, 3, 12, seed=1)
    jacobian[: n // 4, 0] = 0
    jacobian[n // 4 : n // 2, 1] = jacobian[n // 4 : n // 2, 0]
    jacobian[n // 2 : 5 * n // 8, :, :, 1:] = 0
    error = scale * draw(n, 3, 3, seed=2)
    force_error = 1e3 * scale * draw(n, 3, 3, seed=3)
    share = torch.rand(n, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    gain = 10 * draw(n, 3, 3, seed=5).abs()
    gain[::7] = 0
    gain[1::7] = 1e12
    velocity = tip_velocity(error, force_error, share, gain, gain)
    assert velocity.norm(dim=-1).max() <= MAX_SPEED + 1e-12
    step = joint_step(jacobian, velocity, 0.01, posture_error=scale * draw(n, 12, seed=6))
    assert torch.isfinite(step).all()
    assert step.abs().max() <= MAX_STEP + 1e-12


def test_eq25_posture_moves_no_fingertip_and_compliance_is_the_motion_for_a_newton():
    hand = load_hand("allegro")
    joints = 0.5 * (hand.lower + hand.upper)
    jacobian = hand.jacobian(joints)
    step = joint_step(
        jacobian, torch.zeros(3, 3).double(), 0.01, posture_error=draw(12), damping=1e-9
    )
    assert step.norm() > 1e-3
    assert (jacobian @ step).norm() < 1e-3 * step.norm() * jacobian.norm()
    _, pads = hand.fingertips(joints)
    for finger in range(3):
        torque = jacobian[finger].T @ pads[finger]
        bent = torque / torch.tensor([hand.actuators[n].kp for n in hand.joint_names])
        moved = (jacobian[finger] @ bent) @ pads[finger]
        assert float(
            tip_compliance(jacobian, pads, joint_stiffness(hand))[finger]
        ) == pytest.approx(float(moved))


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_closing_gains_are_in_the_hands_frame(name):
    hand, grasp, points, normals = shipped(name)
    gains = closing_gains(grasp, hand, 5.0)
    assert torch.allclose(gains.target, points)
    assert torch.allclose(
        gains.covariance, surface_covariance(normals, grasp.contacts.std_m[0].double())
    )
    assert torch.allclose(gains.position_gain, position_gain(gains.covariance))
    assert ((gains.force_gain > 0) & (gains.force_gain < 0.1)).all()
    assert float(-(gains.desired_force * normals).sum(-1).min()) == pytest.approx(5.0)
    assert torch.allclose(
        apply(grasp.obj_from_hand.double(), points[None]), grasp.contacts.points.double(), atol=1e-6
    )


def test_closing_gains_press_unbalanced_contacts_along_their_normals_and_refuse_bad_arguments():
    hand, grasp, *_ = shipped("allegro")
    same = grasp.contacts.normals[:, :1].expand(1, 3, 3).contiguous()
    contacts = grasp.contacts
    gains = closing_gains(
        dataclasses.replace(grasp, contacts=dataclasses.replace(contacts, normals=same)), hand, 5.0
    )
    assert torch.allclose(
        gains.desired_force, -5.0 * rotate(inverse(grasp.obj_from_hand.double()), same.double())[0]
    )
    assert torch.isfinite(gains.force_gain).all()
    with pytest.raises(BadArgument, match=r"grasp: expected .*got 0 rows"):
        closing_gains(grasp[:0], hand)
    with pytest.raises(BadArgument, match=r"grasps: expected .*got 12 joints"):
        closing_gains(dataclasses.replace(grasp, meta={}), load_hand("barrett"))
    for std_m, found in ((contacts.std_m * float("inf"), "inf"), (None, "None")):
        with pytest.raises(BadArgument, match=rf"std_m: expected .*got {found}"):
            closing_gains(
                dataclasses.replace(grasp, contacts=dataclasses.replace(contacts, std_m=std_m)),
                hand,
            )
    for force in (0.0, -1.0, float("nan")):
        with pytest.raises(BadArgument, match="force"):
            closing_gains(grasp, hand, force)


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_eq28_force_gains_follow_the_learned_variance(name):
    """Along its normal a loop has the bandwidth C_F over the compliance; no finger's force is known
    exactly.
    """
    (hand, grasp, points, normals), model = shipped(name), load_stability(load_hand(name))
    gains = ClosingReference.from_grasp(hand, grasp, 4.0, stability=model).gains
    hand = hand.to("cpu", torch.float64)
    variance = model.preferred_forces(
        points + hand.tips.radius[:, None] * normals
    ).covariance.diagonal()
    sigma = variance[:, None] * normals**2 + FORCE_FLOOR**2
    jacobian = hand.jacobian(grasp.joints.double(), points[None])
    compliance = tip_compliance(jacobian, normals[None], joint_stiffness(hand))[0]
    expected = FORCE_BANDWIDTH * compliance[:, None] * (variance.min() + FORCE_FLOOR**2) / sigma
    assert torch.allclose(gains.force_gain, expected, rtol=1e-6)
    assert gains.force_source == "stability"


def test_reference_approaches_the_forces_that_the_stability_model_prefers():
    (hand, grasp, points, normals), model = shipped("barrett"), load_stability(load_hand("barrett"))
    wanted = model.preferred_forces(points + hand.tips.radius[:, None] * normals, 4.0).forces
    even, led = (
        ClosingReference.from_grasp(hand, grasp, 4.0, stability=x).gains.desired_force
        for x in (None, model)
    )
    assert torch.allclose(led, desired_forces(points, normals, 4.0, wanted), atol=1e-9)
    even, led = (float((-(x * normals).sum(-1) - wanted).norm()) for x in (even, led))
    assert led < 0.9 * even


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_a_given_stiffness_counts_as_that_of_a_hand_with_these_drives(name):
    hand, grasp = pinch(name)
    drives = {joint: drive._replace(kp=7.0) for joint, drive in hand.actuators.items()}
    known = ClosingReference.from_grasp(dataclasses.replace(hand, actuators=drives), grasp)
    given = ClosingReference.from_grasp(hand, grasp, kp=7.0)
    assert torch.equal(given.gains.force_gain, known.gains.force_gain)
    assert torch.equal(given.squeeze, known.squeeze)
    own = ClosingReference.from_grasp(hand, grasp)
    assert not torch.allclose(given.gains.force_gain, own.gains.force_gain)
