"""What is told of the probability of closure, for probabilities whose truth is known."""

import math

import numpy as np
import pytest
import torch
import trimesh
from benchmarks.plan.probability import HARD, draw_contacts, format_reliability, judge_triples, planned_closed

from tests.make import HALF_BALL_RADIUS as RADIUS
from tests.make import half_ball as ball
from torchgrasp.plan.closure import closed_exact


def _asked(power: float, n: int = 4000) -> list[dict]:
    generator = np.random.default_rng(0)
    said, drawn = generator.random(n) ** 0.4, generator.random(n)
    return [
        {"sort": "planned", "family": str(i % 7), "group": "solid", "said": p**power, "closed": bool(y < p)}
        for i, (p, y) in enumerate(zip(said.tolist(), drawn.tolist(), strict=True))
    ]


def test_true_probabilities_are_within_the_bars_and_bold_ones_are_not():
    true, bold = (judge_triples(_asked(power)) for power in (1.0, 0.4))
    worst = [float(row.measured.split()[2].rstrip(",")) for row in (true, bold)]
    assert worst[0] < 0.08 < worst[1]
    assert bold.met is False
    row = planned_closed(_asked(1.0), "solid")
    assert row.met is False and math.isclose(row.numbers["value"], 1 / 1.4, abs_tol=0.03)
    assert "all" in format_reliability(_asked(1.0))


@pytest.mark.parametrize("fingertips", [3, 4])
def test_contacts_are_of_the_estimated_surface_and_hard_ones_close_with_much_friction(fingertips):
    shape = ball(-2.0, std_factor=0.2)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    found = draw_contacts(shape, mesh, 20, 0, fingertips)
    assert set(found) == {"planned", "random", "hard"} and all(len(c) <= 24 for c in found.values())
    assert {c.points.shape[1] for c in found.values()} == {fingertips}
    hard, random = found["hard"], found["random"]
    assert bool(closed_exact(hard.points, hard.normals, HARD).all())
    assert not bool(closed_exact(random.points, random.normals, HARD / 4).all())
    assert float((torch.linalg.vector_norm(hard.points, dim=-1) - RADIUS).abs().max()) < 0.004
