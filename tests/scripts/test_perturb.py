"""Household perturbations: errors of the given amount, each independent of the others, equal for equal seeds."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from benchmarks.perturb import BESIDE, PERTURBATIONS, Perturbation, perturb_trial, perturb_view
from scipy.spatial.transform import Rotation

from torchgrasp.errors import BadArgument
from torchgrasp.specs import TrialSpec
from torchgrasp.values import PointCloud

RADIUS, CAMERA = 0.04, torch.tensor([0.4, 0.1, 0.3], dtype=torch.float64)
CENTRE = torch.tensor([0.0, 0.0, RADIUS], dtype=torch.float64)


def ball(n: int = 1000) -> PointCloud:
    """What the camera sees of a ball on the table, evenly over its image."""
    generator = torch.Generator().manual_seed(5)
    axis = (CAMERA - CENTRE) / (CAMERA - CENTRE).norm()
    normals = torch.randn(20 * n, 3, generator=generator, dtype=torch.float64)
    normals = normals / normals.norm(dim=1, keepdim=True)
    seen = normals @ axis > RADIUS / (CAMERA - CENTRE).norm()
    thin = torch.rand(20 * n, generator=generator, dtype=torch.float64) < normals @ axis
    return PointCloud((CENTRE + RADIUS * normals)[seen & thin][:n], None, CAMERA)


def off_axis(points: torch.Tensor) -> torch.Tensor:
    """Angle between the ray of a point and the ray of the ball's centre."""
    rays = points - CAMERA
    forward = (CENTRE - CAMERA) / (CENTRE - CAMERA).norm()
    return torch.arccos(rays @ forward / rays.norm(dim=1))


SILHOUETTE = math.asin(RADIUS / float((CAMERA - CENTRE).norm()))


def test_nothing_wrong_leaves_cloud_and_table():
    cloud = ball()
    seen, table = perturb_view(cloud, Perturbation(), 0)
    assert seen is cloud and table.offset == 0.0 and table.normal.tolist() == [0.0, 0.0, 1.0]
    assert perturb_trial(TrialSpec(), Perturbation(), 0.7, 0) == TrialSpec()


def test_the_table_is_off_by_the_amounts_about_the_foot_of_the_cloud():
    cloud = ball()
    foot = cloud.points.mean(0) * torch.tensor([1.0, 1.0, 0.0])
    offsets, azimuths = [], []
    for seed in range(60):
        _, high = perturb_view(cloud, PERTURBATIONS["table"], seed)
        offsets.append(high.offset)
        assert high.normal.tolist() == [0.0, 0.0, 1.0]
        _, tilted = perturb_view(cloud, PERTURBATIONS["up"], seed)
        assert math.degrees(math.acos(float(tilted.normal[2]))) == pytest.approx(2.0, abs=1e-9)
        assert abs(float(tilted.height(foot))) < 1e-15
        azimuths.append(math.atan2(float(tilted.normal[1]), float(tilted.normal[0])))
    assert sorted({round(x, 12) for x in offsets}) == [-0.003, 0.003]
    assert 15 < sum(x > 0 for x in offsets) < 45
    assert min(np.histogram(azimuths, 4, (-math.pi, math.pi))[0]) >= 6


def test_a_wrong_camera_moves_all_it_sees_about_itself():
    cloud = ball()
    seen, table = perturb_view(cloud, PERTURBATIONS["camera"], 3)
    assert table.offset == 0.0
    assert seen.viewpoint is not None
    assert float((seen.viewpoint - CAMERA).norm()) == pytest.approx(0.003, rel=1e-9)
    before, after = (cloud.points - CAMERA).numpy(), (seen.points - seen.viewpoint).numpy()
    turn, _ = Rotation.align_vectors(after, before)  # its residual is a difference of large sums
    assert np.abs(turn.apply(before) - after).max() < 1e-12
    assert math.degrees(turn.magnitude()) == pytest.approx(1.0, rel=1e-6)


def test_a_wrong_mask_loses_the_rim_and_finds_the_table_beside():
    cloud = ball()
    for seed in range(5):
        seen, _ = perturb_view(cloud, PERTURBATIONS["mask"], seed)
        kept = (cloud.points[:, None] == seen.points[None]).all(-1).any(1)
        assert int((~kept).sum()) == 50 and len(seen) == 1000
        # the outline of the ball is a circle about the ray of its centre
        lost, angle = off_axis(cloud.points[~kept]), off_axis(cloud.points)
        assert float(lost.min()) > 0.9 * SILHOUETTE
        assert float((lost > angle.quantile(0.8)).double().mean()) == 1.0
        table = seen.points[int(kept.sum()) :]
        assert float(table[:, 2].abs().max()) == 0.0
        assert float(off_axis(table).min()) > SILHOUETTE  # the ball hides none of them
        beside = torch.cdist(table[:, :2], cloud.points[:, :2]).amin(1)
        assert float(beside.max()) <= BESIDE


def test_friction_is_drawn_evenly_and_the_mass_is_the_true_one():
    trials = [perturb_trial(TrialSpec(), PERTURBATIONS["friction"], 0.7, seed) for seed in range(400)]
    friction = np.array([trial.friction for trial in trials])
    assert 0.4 <= friction.min() < 0.41 and 0.99 < friction.max() <= 1.0
    assert friction.std() == pytest.approx(0.6 / math.sqrt(12), rel=0.08)
    assert all(dataclasses.replace(trial, friction=0.8) == TrialSpec() for trial in trials)
    heavy = perturb_trial(TrialSpec(density=100.0), PERTURBATIONS["mass"], 0.7, 0)
    assert heavy.mass == 0.7 and heavy.density is None


def test_each_factor_is_drawn_the_same_alone_and_among_all():
    cloud, everything = ball(), PERTURBATIONS["all"]
    _, table = perturb_view(cloud, everything, 7)
    _, high = perturb_view(cloud, PERTURBATIONS["table"], 7)
    _, tilted = perturb_view(cloud, PERTURBATIONS["up"], 7)
    assert torch.equal(table.normal, tilted.normal)
    foot = cloud.points.mean(0) * torch.tensor([1.0, 1.0, 0.0])
    assert float(table.height(foot)) == pytest.approx(-high.offset * float(tilted.normal[2]), abs=1e-15)
    seen, _ = perturb_view(cloud, everything, 7)
    moved, _ = perturb_view(cloud, PERTURBATIONS["camera"], 7)
    assert torch.equal(seen.viewpoint, moved.viewpoint)  # pyright: ignore[reportArgumentType]
    one, other = (perturb_trial(TrialSpec(), PERTURBATIONS[name], 0.7, 7) for name in ("friction", "all"))
    assert one.friction == other.friction


def test_perturbations_without_a_viewpoint_are_refused():
    blind = dataclasses.replace(ball(), viewpoint=None)
    with pytest.raises(BadArgument, match=r"cloud: expected .*got no viewpoint"):
        perturb_view(blind, PERTURBATIONS["all"], 0)
    assert perturb_view(blind, PERTURBATIONS["table"], 0)[0] is blind
