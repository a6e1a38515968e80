"""Pulls at a grasped cylinder: a firm grasp keeps it, a weak one loses it unless it adapts, and the odds told so."""

import functools

import pytest
import torch
from train.pull_trials import PullRecord, RisingPull, pull_until_lost

from tests.pinch import cylinder, pinch
from torchgrasp.control import ClosingReference, closing_gains
from torchgrasp.control.paper.impedance import Impedance
from torchgrasp.control.paper.stability import lengths_of, load_stability, state_of
from torchgrasp.evaluation.closing import GraspTrial

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]

UP = torch.tensor([0.0, 0.0, 1.0]).double()


def pulled(force: float, most: float, adapts: bool = False) -> PullRecord:
    pytest.importorskip("sapien")
    hand, grasp = pinch("allegro")
    mesh = cylinder()
    holding = functools.partial(Impedance, stability=load_stability(hand) if adapts else None)
    reference = ClosingReference.from_grasp(hand, grasp, force)
    trial = GraspTrial(hand, grasp, mesh, parts=[mesh])
    return pull_until_lost(trial, reference, holding, RisingPull(UP, 4.0, most, 1.5), 0.6)


def test_adaptation_keeps_what_a_weak_grasp_loses():
    weak, adapted = pulled(1.0, 1.8), pulled(1.0, 1.8, adapts=True)
    assert weak.lost
    assert not adapted.lost
    assert adapted.forces[-1].sum() > 1.3 * weak.forces[3].sum()
    assert len(adapted.moved) == len(adapted.pulled) == len(adapted.tips) == 20
    assert adapted.pulled.max() == pytest.approx(1.8)
    assert adapted.pulled[:5].max() == 0


def test_the_odds_before_the_pull_tell_the_firm_grasp_from_the_weak():
    hand, _ = pinch("allegro")
    model = load_stability(hand)
    assert model is not None
    odds = []
    for force in (0.8, 4.0):
        trial = pulled(force, 1.8)
        odds.append(float(model.log_odds(state_of(trial.springs[4], lengths_of(trial.tips[4]), trial.forces[4]))))
        assert trial.lost is (force < 1.0)
    assert odds[0] < 0 < odds[1]


def test_learned_forces_are_balanced_and_named():
    hand, grasp = pinch("allegro")
    gains = closing_gains(grasp, hand, 4.0, load_stability(hand))
    assert gains.force_source == "stability"
    assert closing_gains(grasp, hand, 4.0).force_source == "analytic"
    assert gains.desired_force.sum(0).abs().max() < 1e-9
    assert torch.linalg.cross(gains.target, gains.desired_force).sum(0).abs().max() < 1e-9
    assert (gains.force_gain > 0).all()
