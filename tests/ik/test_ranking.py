"""Ranking: order within groups, the geometric score, and which way each feature of the model of success counts."""

import math

import pytest
import torch

from torchgrasp.ik.ranking import (
    FEATURES,
    centred_friction,
    rank_in_group,
    score,
    success_features,
    success_log_odds,
)
from torchgrasp.values import Contacts

CENTER = torch.tensor([0.0, 0.03, 0.0], dtype=torch.float64)
PADS = torch.tensor([[0.1, 0.3, 0.2]], dtype=torch.float64)
CLOSED = torch.tensor([0.9], dtype=torch.float64)
GOOD = torch.tensor([[4.0, 0.3, 0.3, 0.5, 0.6]])


def test_rank_in_group_against_brute_force(generator):
    cost = torch.randint(0, 40, (200,), generator=generator).double()  # with ties
    group = torch.randint(0, 30, (200,), generator=generator)
    place, counts = torch.zeros(200, dtype=torch.int64), {}
    for i in sorted(range(200), key=lambda i: (float(cost[i]), i)):
        place[i] = counts.get(int(group[i]), 0)
        counts[int(group[i])] = int(place[i]) + 1
    assert torch.equal(rank_in_group(group, cost), place)
    assert len(rank_in_group(group[:0], cost[:0])) == 0


def triple(height: float = 0.0, tilt: float = 0.0) -> Contacts:
    """Three contacts on a vertical cylinder at 120 degrees, normals tilted upward."""
    angle = torch.arange(3, dtype=torch.float64) * 2 * math.pi / 3
    radial = torch.stack([angle.cos(), angle.sin(), torch.zeros(3, dtype=torch.float64)], -1)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    normals = torch.cos(torch.tensor(tilt)) * radial + torch.sin(torch.tensor(tilt)) * up
    return Contacts((0.03 * radial + height * up)[None], normals[None])


def test_centred_friction_is_the_tangent_of_the_tilt():
    torch.testing.assert_close(
        centred_friction(triple(tilt=0.0)), torch.zeros(1, dtype=torch.float64), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        centred_friction(triple(tilt=0.3)), torch.tensor([0.3], dtype=torch.float64).tan(), atol=1e-6, rtol=0
    )


def test_central_untilted_grasps_rank_first():
    pads, center = torch.zeros(1, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    best = score(triple(), pads, center)
    for worse in (triple(height=0.03), triple(tilt=0.5)):
        assert float(score(worse, pads, center)) < float(best)


@pytest.mark.parametrize("name", FEATURES)
def test_every_feature_counts_the_way_it_should(name):
    changed = GOOD.clone()
    changed[0, FEATURES.index(name)] += -2.0 if name == "log-odds of closure" else 0.5
    gain = float(success_log_odds(changed) - success_log_odds(GOOD))
    if name == "mean angle of the pads":  # decides nothing on the bodies of the fit, whose surface is known well
        assert abs(gain) < 0.05
    else:
        assert gain < -0.1


def ring(lift=0.0, shift=0.0):
    """Contacts around z with normals tilted up by `lift` [rad]; forces meet `shift` beside their centre."""
    real = {"dtype": torch.float64}
    around = torch.tensor([0.0, 2.0, 4.0], **real) * math.pi / 3
    out = torch.stack([around.cos(), around.sin(), 0 * around], -1)
    inner = 0.03 * out - torch.tensor([shift, 0.0, 0.0], **real)
    inner = inner / inner.norm(dim=-1, keepdim=True)
    normals = inner * math.cos(lift) + torch.tensor([0.0, 0.0, math.sin(lift)], **real)
    return Contacts(0.03 * out[None], normals[None])


def test_features_of_a_triangle_by_hand():
    cone = math.atan(0.5)
    features = success_features(ring(lift=0.2), CLOSED, PADS, CENTER, 0.5)[0]
    torch.testing.assert_close(
        features, torch.tensor([math.log(9), 1.5, 0.2 / cone, 0.2 / cone, 0.2], dtype=torch.float64), atol=1e-3, rtol=0
    )
    # Forces that meet where the normals do need no friction; those to the centre, half a radius aside, do.
    _, offset, least, lean, _ = success_features(ring(shift=0.01), CLOSED, PADS, CENTER, 0.5)[0]
    aside = math.pi / 3 - math.atan2(math.sqrt(3) / 2, 5 / 6)
    assert float(least) < 0.02 and float(lean) * cone == pytest.approx(aside, abs=1e-6)
    assert float(offset) == pytest.approx(1.5)


def test_features_do_not_depend_on_the_frame_and_are_finite_where_nothing_balances():
    contacts = ring(lift=0.1, shift=0.01)
    turned = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))[0]
    turned = turned * torch.linalg.det(turned)
    points, normals = contacts.points @ turned.T + 1.0, contacts.normals @ turned.T
    moved = Contacts(points, normals)
    again = success_features(moved, CLOSED, PADS, CENTER @ turned.T + 1.0, 0.5)
    torch.testing.assert_close(again, success_features(contacts, CLOSED, PADS, CENTER, 0.5), atol=1e-3, rtol=0)
    certain = success_features(contacts, torch.ones_like(CLOSED), PADS, CENTER, 0.5)
    assert bool(torch.isfinite(certain).all())
    alike = Contacts(points, normals[:, :1].expand(1, 3, 3).contiguous())
    assert float(success_features(alike, CLOSED, PADS, CENTER, 0.5)[0, 2]) == pytest.approx(
        math.pi / 2 / math.atan(0.5)
    )
    assert success_features(contacts[:0], CLOSED[:0], PADS[:0], CENTER, 0.5).shape == (0, 5)
