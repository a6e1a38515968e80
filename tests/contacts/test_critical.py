"""The critical friction against exact tests of closure, and its derivative."""

import pytest
import torch

from tests.contacts.test_forces import judged, tripods
from tests.make import ball_contacts
from torchgrasp import critical_friction
from torchgrasp.contacts.balance import least_friction_forces
from torchgrasp.contacts.critical import least_balance
from torchgrasp.contacts.form_closure import closed_exact
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.linalg import unit

FINGERTIPS = pytest.mark.parametrize("fingertips", [3, 4, 5])
NEAR = 2e-5


@FINGERTIPS
def test_contacts_close_above_the_critical_friction_and_not_below(fingertips, generator):
    contacts = ball_contacts(15, generator, fingertips)
    more = tripods(15, 3, fingertips)
    points = torch.cat([contacts.points, more[0]])
    normals = torch.cat([contacts.normals, more[1]])
    found = critical_friction(points, normals)
    known = torch.isfinite(found)
    assert int(known.sum()) >= 28
    for p, n, friction in zip(points[known], normals[known], found[known].tolist(), strict=True):
        room = NEAR * (1 + friction)
        assert bool(closed_exact(p[None], n[None], friction + room))
        assert friction < room or not bool(closed_exact(p[None], n[None], friction - room))


@FINGERTIPS
def test_the_critical_friction_is_that_of_linear_programmes(fingertips):
    points, normals, oracles = judged(fingertips)
    compared = 0
    for found, oracle in zip(critical_friction(points, normals).tolist(), oracles, strict=True):
        if oracle < 2.0:
            assert found == pytest.approx(oracle, abs=0.02)
            compared += 1
    assert compared >= 5


@FINGERTIPS
def test_the_least_balance_is_differentiable(fingertips):
    points, normals = tripods(2, 3, fingertips)
    assert torch.autograd.gradcheck(
        lambda p, n: least_balance(p, unit(n))[1].friction,
        # in units of the grasp's size
        ((25 * points).requires_grad_(), normals.requires_grad_()),
        fast_mode=True,
    )


def test_contacts_without_a_balance_are_infinite_and_other_numbers_are_refused():
    points, normals = tripods(4, 8)
    normals[0] = normals[0, :1]
    points[1] = points[1, :1]
    points[2, 1] = torch.nan
    found = critical_friction(points, normals)
    assert torch.isfinite(found).tolist() == [False, False, False, True]
    assert critical_friction(points[:0], normals[:0]).shape == (0,)
    alone = critical_friction(points[3].float(), normals[3].float())
    assert alone.item() == pytest.approx(found[3].item(), abs=1e-4)
    with pytest.raises(BadArgument, match="3 to 5 contacts"):
        critical_friction(points[:, :2], normals[:, :2])
    with pytest.raises(BadArgument, match=r"normals: .*unit"):
        critical_friction(points[3], 2.0 * normals[3])
    for count in (2, 6):
        same = points[3, :1].expand(count, 3)
        with pytest.raises(BadArgument, match="3 to 5 contacts"):
            least_friction_forces(same, same)
