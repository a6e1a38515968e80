"""Whether predicted success stays true when a worse camera saw the object: the same authored bodies,
seen by several cameras, and lifted.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

import torch
import trimesh
from scipy.spatial import KDTree
from torch import Tensor
from train.household import CALIBRATING, author_household, family_of, write_bodies

from benchmarks.close.table_lift import BASE, lift_objects
from benchmarks.common import Options, Row, bench, mean_over
from torchgrasp.cloud.camera import partial_view
from torchgrasp.cloud.sensor import SensorName
from torchgrasp.evaluation import ViewScore
from torchgrasp.hand.load import load_hand
from torchgrasp.values.planning import PointCloud

BODIES = 24
APART = 0.05
"""Number of bodies, and the project's bar for predicted minus held."""

SMOOTHED = 0.004
"""Radius [m] of the mean over neighbours: real clouds have edges that are rounded by 3 to 5 mm."""

CROPPED = 0.004
"""Height [m] below which a real cloud has no points: whoever cut the table away took them, too."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera: its noise, and whether its clouds are smoothed and cut off above the table."""

    noise: SensorName | bool = True
    worn: bool = False

    def see(self, mesh: trimesh.Trimesh, pose: Tensor, seed: int) -> PointCloud:
        """Return the points of a mesh that stands on z = 0, as this camera gives them."""
        cloud = partial_view(mesh, pose, noise=self.noise, seed=seed)
        return wear(cloud) if self.worn else cloud


CAMERAS = {
    "exact": Camera(noise=False),
    "default": Camera(),
    "realsense": Camera("realsense"),
    "azure": Camera("azure"),
    "realsense, smoothed and cropped": Camera("realsense", worn=True),
}


def wear(cloud: PointCloud) -> PointCloud:
    """Return a cloud whose points are means of their neighbours, without the lowest ones."""
    points = cloud.points.double()
    near = KDTree(points.numpy()).query_ball_point(points.numpy(), SMOOTHED)
    smooth = torch.stack([points[some].mean(0) for some in near])
    return dataclasses.replace(cloud, points=smooth[smooth[:, 2] > CROPPED])


@bench("close/sensors")
def sensors(o: Options) -> list[Row]:
    """Lift the first grasp of each body from what each camera saw of it."""
    numbers = (k for k in itertools.count() if family_of(k) in CALIBRATING)
    bodies = list(map(author_household, itertools.islice(numbers, o.times(BODIES))))
    rows = list[Row]()
    for hand in map(load_hand, o.hands):
        for name, camera in CAMERAS.items():
            folder = o.out / "sensors" / name.replace(", ", "_").replace(" ", "_")
            if not (folder / "manifest.json").is_file():
                write_bodies(folder, {x.name: x.mesh for x in bodies}, camera.see)
            mine = dataclasses.replace(o, objects=(Path(folder),), names=(), draws=1, tries=1)
            scores = lift_objects(mine, hand, BASE, o.simulator, 1)
            rows.append(_row(f"{hand.name}, {name}", scores))
            print(rows[-1], flush=True)
    return rows


def _row(what: str, scores: Sequence[ViewScore]) -> Row:
    """Return the mean predicted success beside the share that rose, over families."""
    tried = [(x.unit, a) for x in scores for a in x.attempts]
    predicted = mean_over((unit, a.predicted) for unit, a in tried)
    risen = mean_over((unit, float(a.passed)) for unit, a in tried)
    apart = mean_over((unit, a.predicted - a.passed) for unit, a in tried)
    words = f"predicted {predicted.value:.2f}, rose {risen.value:.2f} of {len(tried)}; "
    words += f"predicted minus rose {apart.value:+.2f} [{apart.low:+.2f}, {apart.high:+.2f}]; "
    words += f"no grasp for {sum(not x.attempts for x in scores)}"
    numbers = {"apart": apart, "predicted": predicted, "risen": risen}
    return Row(what, f"within {APART}", words, abs(apart.value) <= APART, numbers)
