"""The clutch: coupled below the torque, the outer link alone above it, and coupled again once the finger opens."""

import dataclasses

import pytest
import torch

from tests.pinch import QUICK, close, pinch
from torchgrasp.control.observation import model_from_hand
from torchgrasp.sim.breakaway import Breakaway


def barrett():
    hand, grasp = pinch("barrett")
    model = model_from_hand(hand, grasp)
    index = {name: k for k, name in enumerate(hand.tree.joint_names)}
    return model, index


def test_the_outer_link_takes_the_whole_turn_of_the_motor():
    model, index = barrett()
    clutch = Breakaway(model, torque=1.0)
    at = lambda flex: model.expand(torch.tensor([0.3, flex, 1.0, 1.0], dtype=torch.float64))  # noqa: E731
    stopped = at(1.0)
    inner, outer = index["f1_flex"], index["f1_distal"]
    torch.testing.assert_close(clutch(at(1.05), stopped), at(1.05))  # 10 N m/rad x 0.05 rad: it presses, coupled
    torch.testing.assert_close(clutch(at(1.2), stopped), at(1.2))  # from here on
    driven = clutch(at(1.5), stopped)
    assert float(driven[inner]) == pytest.approx(1.2)
    assert float(driven[outer] - at(1.2)[outer]) == pytest.approx((1 + 1 / 3) * 0.3)
    others = [k for k in range(len(driven)) if k not in (inner, outer)]
    torch.testing.assert_close(driven[others], at(1.5)[others])
    torch.testing.assert_close(clutch(at(1.1), at(1.1)), at(1.1))  # opened: coupled again
    torch.testing.assert_close(clutch(at(1.15), at(1.14)), at(1.15))


def test_a_hand_without_geared_fingers_has_no_clutch():
    hand, grasp = pinch("allegro")
    targets = torch.rand(len(hand.tree.joint_names), dtype=torch.float64)
    assert torch.equal(Breakaway(model_from_hand(hand, grasp), 1e-6)(targets, 0 * targets), targets)


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_the_clutch_is_an_option_of_a_trial():
    plain = close("barrett", spec=QUICK)
    never = close("barrett", spec=dataclasses.replace(QUICK, breakaway=50.0))
    early = close("barrett", spec=dataclasses.replace(QUICK, breakaway=0.05))
    assert torch.equal(plain.joints, never.joints)
    assert not torch.equal(plain.joints, early.joints)
    ratio = lambda result: result.joints[-1][[result.joint_names.index(n) for n in ("f3_distal", "f3_flex")]]  # noqa: E731
    (outer, inner), (outer_0, inner_0) = ratio(early).tolist(), ratio(plain).tolist()
    assert outer - inner / 3 > outer_0 - inner_0 / 3 + 0.01
