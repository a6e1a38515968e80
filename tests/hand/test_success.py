"""The model of success: what it is shipped with, and which way each thing that it knows of a grasp counts."""

import json
import math

import pytest
import torch

from torchgrasp.hand.success import FEATURES, MODEL, success_features, success_odds
from torchgrasp.values import Contacts

GOOD = torch.tensor([[4.0, 0.3, 0.5, 0.4, math.atan(0.6)]])


@pytest.mark.parametrize(("name", "worse"), zip(FEATURES, (-4.0, 1.0, 1.0, 0.5, -0.2), strict=True))
def test_every_feature_counts_the_way_it_should(name, worse):
    changed = GOOD.clone()
    changed[0, FEATURES.index(name)] += worse
    assert float(success_odds(changed)) < float(success_odds(GOOD))


def test_the_shipped_model_beats_the_base_rate_where_it_was_not_fitted():
    model = json.loads(MODEL.read_text())
    assert model["brier_on_objects_not_fitted_on"] < model["brier_of_the_base_rates"]
    assert set(model["weights"]) == set(FEATURES) and model["fitted_on"] and model["trial"]


def test_features_of_a_triangle_by_hand():
    real = {"dtype": torch.float64}
    around = torch.tensor([0.0, 2.0, 4.0], **real) * math.pi / 3
    out = torch.stack([around.cos(), around.sin(), 0 * around], -1)
    tilted = out * math.cos(0.2) + torch.tensor([0.0, 0.0, math.sin(0.2)], **real)
    spread = torch.full((1, 3), 0.004, **real)
    contacts = Contacts(0.03 * out[None], tilted[None], spread, spread)
    angles = torch.tensor([[0.1, 0.3, 0.2]], **real)
    center = torch.tensor([0.0, 0.03, 0.0], **real)
    found = success_features(contacts, torch.tensor([0.9], **real), angles, center, 0.5)[0]
    expected = [math.log(9), 1.5, 0.2 / math.atan(0.5), 0.3, math.atan(0.5)]
    torch.testing.assert_close(found, torch.tensor(expected, **real))
    turned = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0), **real))[0]
    moved = Contacts(contacts.points @ turned.T + 1.0, contacts.normals @ turned.T, spread, spread)
    again = success_features(moved, torch.tensor([0.9], **real), angles, center @ turned.T + 1.0, 0.5)[0]
    torch.testing.assert_close(again, found)
    certain = success_features(contacts, torch.tensor([1.0], **real), angles, center, 0.5)
    assert bool(torch.isfinite(certain).all())
