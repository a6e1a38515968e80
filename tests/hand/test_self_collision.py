"""Self-collision against exact distances of the URDF's shapes (coal), and against its own
definition.
"""

import numpy as np
import pytest
import torch

from torchgrasp import Hand, load_hand
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import rotation_from_vector
from torchgrasp.hand.collision_shapes import (
    MEETING_DISTANCE,
    collision_pairs,
    draw_postures,
    met_pairs,
    self_collision_from_urdf,
)
from torchgrasp.hand.hand_toml import read_hand_toml
from torchgrasp.hand.kinematics import tree_from_urdf
from torchgrasp.hand.urdf import Mimic, read_urdf
from torchgrasp.testing import check_hand, random_joints

HANDS = [("allegro", "default"), ("allegro", "paper_literal"), ("barrett", "default")]


@pytest.fixture(params=HANDS, ids=["-".join(h) for h in HANDS])
def hand(request) -> Hand:
    return load_hand(*request.param)


def frames_of(hand: Hand, joints: torch.Tensor) -> torch.Tensor:
    return hand.tree.frames(hand.expand_joints(joints).T.contiguous())


def test_self_collision_agrees_with_exact_hulls(hand):
    pytest.importorskip("coal")
    from tests.hand.coal_reference import exact_clearance

    joints = random_joints(hand, 300)
    truth = exact_clearance(hand, joints)
    found = hand.self_clearance(joints).numpy()
    met = truth < 0
    wrong = (truth < 0) != (found < 0)
    assert 0.1 < met.mean() < 0.5
    assert wrong.mean() < 0.01
    assert (wrong & met).mean() < 0.01
    np.testing.assert_allclose(
        found[met & ~wrong], truth[met & ~wrong], atol=1e-3
    )  # Barrett's palm is a prism
    assert (
        found.clip(max=MEETING_DISTANCE)[~met] <= truth[~met] + 1e-3
    ).all()  # pairs farther apart than that are not tested
    assert (found[~met & ~wrong] >= truth[~met & ~wrong] / 3**0.5 - 1e-3).all()


def test_clearance_is_the_least_of_all_pairs_in_float32_too(hand):
    joints = random_joints(hand, 500)
    every = hand.self_collision.separations(frames_of(hand, joints), torch.inf)
    torch.testing.assert_close(hand.self_clearance(joints), every.amin(0), atol=1e-14, rtol=0)
    torch.testing.assert_close(
        hand.self_clearance(joints, chunk=7), every.amin(0), atol=1e-14, rtol=0
    )
    for below in (0.0, 0.004):
        found = hand.self_clearance(joints, below=below)
        torch.testing.assert_close(
            found.clamp_max(below), every.amin(0).clamp_max(below), atol=1e-14, rtol=0
        )
    near = hand.self_collision.separations(frames_of(hand, joints), 0.002)
    torch.testing.assert_close(near.clamp_max(0.002), every.clamp_max(0.002), atol=1e-14, rtol=0)
    joints = random_joints(hand, 500).float()
    found = hand.self_clearance(joints)
    assert found.dtype == torch.float32
    torch.testing.assert_close(
        found.double(), hand.self_clearance(joints.double()), atol=2e-5, rtol=0
    )


def test_clearance_gradient_equals_finite_differences(hand, generator):
    joints = random_joints(hand, 60).requires_grad_()
    (gradient,) = torch.autograd.grad(hand.self_clearance(joints).sum(), joints)
    step = 1e-6 * torch.randn(60, hand.dof, generator=generator, dtype=torch.float64)
    with torch.no_grad():
        change = (hand.self_clearance(joints + step) - hand.self_clearance(joints - step)) / 2
    same = (change - (gradient * step).sum(1)).abs() < 1e-3 * step.norm(dim=1)
    assert float(same.double().mean()) > 0.95  # the rest: the closest pair changes within the step


def test_pushes_are_the_derivative_by_a_motion_of_the_second_shape(hand, generator):
    itself = hand.self_collision
    frames = frames_of(hand, random_joints(hand, 1))
    shaken = rotation_from_vector(
        0.1 * torch.randn(frames.shape[2], 3, generator=generator, dtype=torch.float64)
    )
    frames = torch.einsum(
        "lij,jkln->ikln", shaken, frames
    )  # no two axes are parallel, where it has kinks
    separation, number, wrench = itself.pushes(frames, torch.inf)
    assert torch.equal(separation, itself.separations(frames, torch.inf))
    near, at, pushes = itself.pushes(frames, 0.02)  # only near pairs push
    assert torch.equal(near < 0.02, separation < 0.02) and torch.equal(
        pushes[:, at].abs().amax(0) > 0, near < 0.02
    )
    found = wrench[:, number[:, 0]]
    links = itself.link[itself.pairs[:, 1]]
    step = 1e-6 * torch.randn(6, generator=generator, dtype=torch.float64)
    for link in links.unique().tolist():
        moved = frames.clone(), frames.clone()
        for sign, some in zip((1, -1), moved, strict=True):
            some[..., link, 0] += sign * torch.linalg.cross(
                step[3:, None].expand(3, 4), some[..., link, 0], dim=0
            )
            some[:, 3, link, 0] += sign * step[:3]
        ahead, back = (itself.separations(some, torch.inf)[:, 0] for some in moved)
        mine = links == link
        torch.testing.assert_close(
            (step @ found)[mine], ((ahead - back) / 2)[mine], atol=1e-10, rtol=1e-4
        )


@pytest.mark.parametrize("name", ["allegro", "barrett"])
def test_pairs_of_the_shipped_hands_are_the_learned_ones(name):
    hand = load_hand(name)
    spec = read_hand_toml(hand.urdf_path.parent / "hand.toml")
    assert spec.pairs is not None
    learned = collision_pairs(read_urdf(hand.urdf_path), spec.coupling, n=3000)
    left_out = {("palm", "f1_med"), ("palm", "f2_med")} & set(learned)
    assert set(learned) - left_out <= set(spec.pairs)
    assert len(left_out) == (2 if name == "barrett" else 0)
    assert len(learned) > 0.8 * len(spec.pairs)
    assert list(spec.pairs) == sorted(
        spec.pairs, key=lambda pair: [hand.tree.link_names.index(x) for x in pair]
    )


def test_a_pair_that_is_named_twice_meets_twice():
    hand = load_hand("barrett")
    urdf = read_urdf(hand.urdf_path)
    spec = read_hand_toml(hand.urdf_path.parent / "hand.toml")
    assert spec.pairs is not None
    postures = draw_postures(urdf, spec.coupling, 200, seed=0)
    once = met_pairs(urdf, spec.pairs, postures)
    assert bool(once.any())
    twice = [*spec.pairs, *((b, a) for a, b in spec.pairs)]
    assert torch.equal(met_pairs(urdf, twice, postures), torch.cat([once, once]))


def test_links_that_always_or_never_meet_are_no_pairs_and_a_hand_without_any_is_always_clear(
    toy_hand,
):
    urdf = read_urdf(toy_hand / "hand.urdf")
    assert (
        collision_pairs(urdf, {}, n=50) == [("t1", "t2"), ("t2", "t3")]
        or collision_pairs(urdf, {}, n=50) == []
    )
    with pytest.raises(BadArgument, match=r"coupling: expected .*got j9"):
        collision_pairs(urdf, {"j9": Mimic("j1", 1.0, 0.0)}, n=50)
    with pytest.raises(BadArgument, match=r"n: expected .*got 0"):
        collision_pairs(urdf, {}, n=0)
    text = (toy_hand / "hand.toml").read_text()
    (toy_hand / "hand.toml").write_text(
        text.replace("[options", "[self_collision]\npairs = []\n[options", 1)
    )
    hand = check_hand(toy_hand)
    assert hand.self_clearance(torch.zeros(3, 3)).tolist() == [torch.inf] * 3


def test_cylinders_are_within_two_percent(tmp_path):
    path = tmp_path / "hand.urdf"
    shape = "<collision><geometry><{}/></geometry></collision>"
    path.write_text(
        '<robot name="two"><link name="base">'
        + shape.format('cylinder radius="0.05" length="0.1"')
        + "</link>"
        '<link name="ball">' + shape.format('sphere radius="0.01"') + '</link><link name="arm"/>'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>'
        '<limit lower="-4" upper="4"/></joint><joint name="out" type="prismatic"><parent link="arm"/>'
        '<child link="ball"/><axis xyz="1 0 0"/><limit lower="0" upper="1"/></joint></robot>'
    )
    urdf = read_urdf(path)
    tree = tree_from_urdf(urdf)
    itself = self_collision_from_urdf(urdf, None)
    around = torch.stack(
        [torch.linspace(-4, 4, 200, dtype=torch.float64), torch.full((200,), 0.09).double()]
    )
    error = itself.clearance(tree.frames(around)) - 0.03
    assert float(error.abs().max()) < 0.02 * 0.05
    assert abs(float(error.mean())) < 0.005 * 0.05
