"""The bench of a given target among neighbours: where bodies stand, what hides what, and how a
result is told.
"""

import math

import numpy as np
import pytest
import torch
import trimesh

pytest.importorskip("manifold3d")

from benchmarks.scene.target import (
    COVERED,
    PIXELS,
    TOUCHING,
    TargetTry,
    are_elsewhere,
    describe,
    largest_motion,
    make_clutter,
    middle_of,
    moved,
    push_together,
)

from torchgrasp import load_object
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.geometry.frames import rigid, rotation_from_vector


def test_boxes_are_pushed_together_until_their_gap_is_reached():
    boxes = [trimesh.creation.box((0.04, 0.06, 0.02)) for _ in range(4)]
    poses = push_together(boxes, np.random.default_rng(0))
    corners = [moved(box, pose).vertices[:, :2] for box, pose in zip(boxes, poses, strict=True)]
    grid = np.linspace(0, 1, 60)
    rims = [rim_of(c, grid) for c in corners]
    gaps = [
        np.linalg.norm(a[:, None] - b[None], axis=-1).min()
        for k, a in enumerate(rims)
        for b in rims[:k]
    ]
    assert min(gaps) >= TOUCHING
    assert all(  # each stands before one that came earlier
        min(np.linalg.norm(rims[k][:, None] - b[None], axis=-1).min() for b in rims[:k]) < 0.06
        for k in range(1, 4)
    )


def rim_of(corners: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return points on the sides of the rectangle with these corners."""
    centre = corners.mean(0)
    order = np.argsort(np.arctan2(*(corners - centre).T))
    around = np.unique(corners[order].round(9), axis=0)
    around = around[np.argsort(np.arctan2(*(around - centre).T))]
    sides = zip(around, np.roll(around, 1, 0), strict=True)
    return np.concatenate([a + grid[:, None] * (b - a) for a, b in sides])


def test_every_second_scene_hides_a_part_of_its_target():
    clutter = make_clutter(np.random.default_rng(3), 1)
    assert clutter.hidden >= COVERED
    assert int((clutter.labels == 1).sum()) >= PIXELS
    assert len(clutter.names) == len(clutter.meshes) == len(clutter.parts) >= 3
    assert all(abs(mesh.bounds[0, 2]) < 1e-6 for mesh in clutter.meshes)


def test_the_largest_motion_is_that_of_the_middle_and_not_of_the_origin():
    box = trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation((0.3, 0, 0))
    turn = rotation_from_vector(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    about_origin = rigid(turn, torch.zeros(3, dtype=torch.float64))
    rest = torch.eye(4, dtype=torch.float64)
    found = largest_motion([box, box], torch.stack([rest, about_origin]))
    assert found == pytest.approx(0.3 * math.sqrt(2))


def test_the_middle_of_a_mask_is_farthest_from_its_rim():
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[5:14, 10:19] = True
    assert middle_of(mask) == (14, 9)


def test_a_refused_click_counts_as_asked_and_a_lost_target_does_not():
    held = TargetTry(0, "can", 2, 0.0, "click", 1.0, 1.0, 5, 0.9, "OK", 0.0, True)
    lost = TargetTry(1, "cup", 2, 0.5, "click", 1.0, 1.0, 5, 0.8, "DROPPED", 0.03, True)
    refused = TargetTry(2, "jar", 3, 0.9, "click", said="too few pixels", clear=1)
    rows = {row.what: row for row in describe("click", [held, lost, refused])}
    assert (
        "held 33.3 %" in rows["target by click"].measured
        and "asked 66.7 %" in rows["target by click"].measured
    )
    assert rows["target by click, up to three grasps"].measured.startswith("held 66.7 %")
    assert rows["a neighbour moved by more than 2 cm, click"].measured.startswith("50.0 %")
    assert rows["predicted minus held, click"].measured.startswith("+0.350")
    assert "0.33 to 0.67: 0 held, 0 without a grasp of 1" in (
        rows["by the share hidden, click"].measured
    )


def test_grasps_of_the_target_are_there_and_those_of_its_neighbour_elsewhere():
    jug = load_object("jug").mesh
    grasp = load_shipped_grasp("jug", "allegro")
    assert not are_elsewhere(grasp, jug)
    beside = rigid(torch.eye(3, dtype=torch.float64), torch.tensor([0.3, 0.0, 0.0]).double())
    assert are_elsewhere(grasp, moved(jug, beside))
