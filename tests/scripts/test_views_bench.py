"""scripts/bench.py shape --only views: where the clouds of its cameras lie."""

import torch
import trimesh
from benchmarks.close.sensors import CAMERAS
from benchmarks.shape.views import Cell

from torchgrasp.cloud import look_at


def test_later_views_are_misplaced_with_their_camera_and_the_first_is_not() -> None:
    box = trimesh.creation.box((0.05, 0.05, 0.05))
    pose = look_at(30.0, 40.0, target=box)
    cell = Cell(CAMERAS["exact"], 0.01)
    first = cell.see(box, pose, 0)
    later = cell.see(box, pose, 1)
    assert first.viewpoint is not None and later.viewpoint is not None
    torch.testing.assert_close(first.viewpoint, pose[:3, 3])
    shift = later.viewpoint - pose[:3, 3]
    assert 0.003 < shift.norm() < 0.05
    # a point of a cube's surface has a largest coordinate of half the side
    for cloud, moved in ((first, torch.zeros_like(shift)), (later, shift)):
        farthest = (cloud.points - moved).abs().amax(1)
        torch.testing.assert_close(farthest, torch.full_like(farthest, 0.025), rtol=0, atol=1e-6)
