"""Occupancy of rendered scenes of boxes, against the true boxes."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh

from torchgrasp import Scene
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene import estimate_occupancy
from torchgrasp.scene.image import DepthImage

BOXES = {  # size and position of the lower face's middle
    1: ((0.06, 0.06, 0.08), (0.0, 0.0)),
    2: ((0.05, 0.08, 0.12), (0.02, 0.12)),
    3: ((0.08, 0.05, 0.06), (-0.12, 0.02)),
    4: ((0.05, 0.05, 0.1), (0.1, -0.1)),
}
CAMERA = look_at(20.0, 40.0, 0.6, torch.tensor([0.0, 0.0, 0.04]))


def box(size, place):
    mesh = trimesh.creation.box(size)
    mesh.apply_translation([*place, size[2] / 2])
    return mesh


@pytest.fixture(scope="module")
def scene():
    """A noisy view of the boxes; box 1 is the target."""
    depth, labels = render_depth([box(*b) for b in BOXES.values()], CAMERA, seed=1)
    pixels = torch.nonzero(depth > 0)
    points = cloud_from_depth(depth, INTRINSICS, camera_pose=CAMERA).points
    image = DepthImage(depth, INTRINSICS, CAMERA)
    return Scene(
        points, labels[pixels[:, 0], pixels[:, 1]], image, pixels, Plane.horizontal(0.0), 1
    )


@pytest.fixture(scope="module")
def occupancy(scene):
    return estimate_occupancy(scene, 1)


def signed(points, which):
    """Signed distance (Chebyshev) to the nearest of some boxes."""
    parts = []
    for k in which:
        size, place = BOXES[k]
        middle = torch.tensor([*place, size[2] / 2], dtype=torch.float64)
        parts.append(
            ((points - middle).abs() - torch.tensor(size, dtype=torch.float64) / 2).amax(-1)
        )
    return torch.stack(parts).amin(0)


def test_boxes_are_found_where_they_are(occupancy):
    truth = signed(occupancy.centres, (2, 3, 4))
    p = occupancy.probability
    assert bool(((p >= 0) & (p <= 1)).all())
    full = p >= 0.5
    assert float(full[truth < -0.005].double().mean()) > 0.85  # what is full is said to be full
    assert float((truth[full] < 0.01).double().mean()) > 0.85  # and hardly anything else


def test_what_the_camera_sees_through_is_never_full(occupancy):
    centres = occupancy.centres.reshape(-1, 3)[::7]
    ahead = CAMERA[:3, 3] - centres
    meshes = trimesh.util.concatenate([box(*b) for b in BOXES.values()])
    hidden = meshes.ray.intersects_any(centres.numpy(), ahead.numpy())
    free = ~torch.from_numpy(hidden) & (
        signed(centres, BOXES) > 0.025
    )  # rim pixels fly off by up to that
    assert int(free.sum()) > 10_000
    p = occupancy.probability.reshape(-1)[::7][free]
    assert float(p.max()) < 0.5
    assert float((p > 0.01).double().mean()) < 0.002


def test_the_target_and_the_table_are_no_obstacles(scene, occupancy):
    inside = signed(occupancy.centres, (1,)) < -0.005
    assert float(occupancy.probability[inside].max()) < 0.3
    lone = dataclasses.replace(scene, labels=torch.where(scene.labels == 1, 1, 0), table=None)
    assert float(estimate_occupancy(lone, 1).probability.max()) < 0.3


def test_things_without_label_are_obstacles_and_the_targets_rim_is_not(scene, occupancy):
    unlabelled = dataclasses.replace(scene, labels=torch.where(scene.labels == 1, 1, 0))
    same = estimate_occupancy(unlabelled, 1)
    assert (
        float(((same.probability >= 0.5) != (occupancy.probability >= 0.5)).double().mean()) < 0.01
    )

    from scipy.ndimage import binary_closing, binary_erosion

    mask = np.zeros(scene.image.depth.shape, bool)
    row, column = scene.pixels.T.numpy()
    mask[row, column] = (scene.labels == 1).numpy()
    shrunk = torch.from_numpy(
        binary_erosion(binary_closing(mask, iterations=3), iterations=3)[row, column]
    )
    trimmed = dataclasses.replace(
        scene, labels=torch.where((scene.labels == 1) & ~shrunk, 0, scene.labels)
    )
    p = estimate_occupancy(trimmed, 1)
    near = signed(p.centres, (1,)) < 0.01
    assert float((p.probability[near] >= 0.5).double().mean()) < 0.005


def test_a_label_without_points_is_refused(scene):
    with pytest.raises(BadArgument, match="target"):
        estimate_occupancy(scene, 9)
