"""Dropped scenes: at rest on the table, in view, and the same in every process."""

import hashlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.clutter import write_objects
from torchgrasp.cloud.camera import INTRINSICS
from torchgrasp.errors import BadArgument
from torchgrasp.evaluation.placed import drop, settle

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    pytest.importorskip("sapien")
    return write_objects(tmp_path_factory.mktemp("objects"))


def digest(scene):
    arrays = [mesh.vertices for mesh in scene.meshes] + [scene.camera_pose.numpy()]
    return hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()


def test_a_seed_gives_one_scene_here_and_in_another_process(objects):
    first = drop(objects, (3, 5), 4)
    drop(objects, (3, 5), 5)
    assert digest(first) == digest(drop(objects, (3, 5), 4)) != digest(drop(objects, (3, 5), 5))
    code = (
        "import sys, warnings; warnings.simplefilter('ignore'); from pathlib import Path; "
        "from tests.evaluation.test_placed import digest, drop; print(digest(drop(Path(sys.argv[1]), (3, 5), 4)))"
    )
    run = [sys.executable, "-c", code, str(objects)]
    other = subprocess.run(run, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    assert other.stdout.strip() == digest(first)


@pytest.mark.parametrize("seed", range(4))
def test_objects_rest_on_the_table_within_reach_and_in_view(objects, seed):
    scene = drop(objects, (3, 6), seed)
    assert 3 <= len(scene) <= 6 and len(set(scene.names)) == len(scene)
    lowest = [mesh.bounds[0, 2] for mesh in scene.meshes]
    assert min(lowest) > -2e-3 and min(lowest) < 1e-3
    assert np.linalg.norm(scene.centres()[:, :2], axis=1).max() < 0.25
    world = np.concatenate([mesh.vertices for mesh in scene.meshes])
    camera = np.linalg.inv(scene.camera_pose.numpy())
    x, y, w = INTRINSICS.numpy() @ (camera[:3, :3] @ world.T + camera[:3, 3:])
    assert (0 < x / w).all() and (x / w < 639).all() and (0 < y / w).all() and (y / w < 479).all()
    still = torch.eye(4, dtype=torch.float64).expand(len(scene), 4, 4)
    again = settle(scene, still, range(len(scene)))
    assert np.linalg.norm(again.centres() - scene.centres(), axis=1).max() < 2e-3
    fewer = settle(scene, still, [1, 2])
    assert fewer.names == scene.names[1:3] and fewer.centres()[:, 2].max() <= scene.centres()[1:3, 2].max() + 1e-3


def test_what_cannot_be_dropped_is_refused(objects, tmp_path):
    with pytest.raises(BadArgument, match="mesh"):
        drop(tmp_path, (3, 5), 0)
    with pytest.raises(BadArgument, match="count"):
        drop(objects, (5, 3), 0)
    assert len(drop(None, (6, 6), 0)) == 6  # more than there are: some twice
