"""Household perturbations: errors of the given amount, each independent of the others, equal for
equal seeds.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch
from benchmarks.perturb import BESIDE, PERTURBATIONS, Perturbation, perturb_trial, perturb_view
from scipy.spatial.transform import Rotation

from tests.make import directions, real
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.planning import PointCloud
from torchgrasp.values.specs import TrialSpec

RADIUS = 0.04
CAMERA = real([0.4, 0.1, 0.3])
CENTRE = real([0.0, 0.0, 0.04])
DISTANCE = float((CAMERA - CENTRE).norm())


def seen_ball(n: int = 1000) -> PointCloud:
    """What the camera sees of a ball on the table, evenly over its image."""
    normals = directions(20 * n, 5)
    facing = normals @ (CAMERA - CENTRE) / DISTANCE
    even = (
        torch.rand(20 * n, generator=torch.Generator().manual_seed(5), dtype=torch.float64) < facing
    )
    return PointCloud(
        (CENTRE + RADIUS * normals)[(facing > RADIUS / DISTANCE) & even][:n], None, CAMERA
    )


CLOUD = seen_ball()
FOOT = CLOUD.points.mean(0) * real([1.0, 1.0, 0.0])


def off_axis(points: torch.Tensor) -> torch.Tensor:
    """Angle between the ray of a point and the ray of the ball's centre."""
    rays = points - CAMERA
    return torch.arccos(rays @ (CENTRE - CAMERA) / DISTANCE / rays.norm(dim=1))


def test_nothing_wrong_leaves_cloud_and_table():
    seen, table = perturb_view(CLOUD, Perturbation(), 0)
    assert seen is CLOUD and table.offset == 0.0 and table.normal.tolist() == [0.0, 0.0, 1.0]
    assert perturb_trial(TrialSpec(), Perturbation(), 0.7, 0) == TrialSpec()


def test_the_table_is_off_by_the_amounts_about_the_foot_of_the_cloud():
    high = [perturb_view(CLOUD, PERTURBATIONS["table"], seed)[1] for seed in range(60)]
    tilted = [perturb_view(CLOUD, PERTURBATIONS["up"], seed)[1] for seed in range(60)]
    offsets = [table.offset for table in high]
    assert all(table.normal.tolist() == [0.0, 0.0, 1.0] for table in high)
    assert (
        sorted({round(x, 12) for x in offsets}) == [-0.003, 0.003]
        and 15 < sum(x > 0 for x in offsets) < 45
    )
    normals = torch.stack([table.normal for table in tilted]).numpy()
    assert np.degrees(np.arccos(normals[:, 2])) == pytest.approx(2.0, abs=1e-9)
    assert max(abs(float(table.height(FOOT))) for table in tilted) < 1e-15
    assert (
        min(np.histogram(np.arctan2(normals[:, 1], normals[:, 0]), 4, (-math.pi, math.pi))[0]) >= 6
    )


def test_a_wrong_camera_moves_all_it_sees_about_itself():
    seen, table = perturb_view(CLOUD, PERTURBATIONS["camera"], 3)
    assert table.offset == 0.0 and seen.viewpoint is not None
    assert float((seen.viewpoint - CAMERA).norm()) == pytest.approx(0.003, rel=1e-9)
    before = (CLOUD.points - CAMERA).numpy()
    after = (seen.points - seen.viewpoint).numpy()
    turn, _ = Rotation.align_vectors(after, before)  # its residual is a difference of large sums
    assert np.abs(turn.apply(before) - after).max() < 1e-12
    assert math.degrees(turn.magnitude()) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_wrong_mask_loses_the_rim_and_finds_the_table_beside(seed):
    seen, _ = perturb_view(CLOUD, PERTURBATIONS["mask"], seed)
    kept = (CLOUD.points[:, None] == seen.points[None]).all(-1).any(1)
    assert int((~kept).sum()) == 50 and len(seen) == 1000
    # the outline of the ball is a circle about the ray of its centre
    outline = math.asin(RADIUS / DISTANCE)
    assert float(off_axis(CLOUD.points[~kept]).min()) > 0.9 * outline
    table = seen.points[int(kept.sum()) :]
    assert float(table[:, 2].abs().max()) == 0.0 and float(off_axis(table).min()) > outline
    assert float(torch.cdist(table[:, :2], CLOUD.points[:, :2]).amin(1).max()) <= BESIDE


def test_friction_is_drawn_evenly_and_the_mass_is_the_true_one():
    trials = [
        perturb_trial(TrialSpec(), PERTURBATIONS["friction"], 0.7, seed) for seed in range(200)
    ]
    friction = np.array([trial.friction for trial in trials])
    assert 0.4 <= friction.min() < 0.42 and 0.98 < friction.max() <= 1.0
    assert friction.std() == pytest.approx(0.6 / math.sqrt(12), rel=0.1)
    assert all(dataclasses.replace(trial, friction=0.8) == TrialSpec() for trial in trials)
    heavy = perturb_trial(TrialSpec(density=100.0), PERTURBATIONS["mass"], 0.7, 0)
    assert heavy.mass == 0.7 and heavy.density is None


def test_each_factor_is_drawn_the_same_alone_and_among_all():
    views = {
        name: perturb_view(CLOUD, PERTURBATIONS[name], 7)
        for name in ("all", "table", "up", "camera")
    }
    tilted = views["up"][1]
    high = views["table"][1]
    (seen, table) = views["all"]
    assert torch.equal(table.normal, tilted.normal)
    assert float(table.height(FOOT)) == pytest.approx(
        -high.offset * float(tilted.normal[2]), abs=1e-15
    )
    assert torch.equal(seen.viewpoint, views["camera"][0].viewpoint)  # pyright: ignore[reportArgumentType]
    one, other = (
        perturb_trial(TrialSpec(), PERTURBATIONS[name], 0.7, 7) for name in ("friction", "all")
    )
    assert one.friction == other.friction


def test_perturbations_without_a_viewpoint_are_refused():
    blind = dataclasses.replace(CLOUD, viewpoint=None)
    with pytest.raises(BadArgument, match=r"cloud: expected .*got no viewpoint"):
        perturb_view(blind, PERTURBATIONS["all"], 0)
    assert perturb_view(blind, PERTURBATIONS["table"], 0)[0] is blind
