"""Estimation of obstacles: the probability that each place around the target is full of something
else.

Space in front of a measured depth is free. Behind an object's visible surface, a model estimates
the probability. It uses the object's visible size and the place behind the surface.
`scripts/train.py occupancy` fits the model.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, flatnonzero, settle
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import ndimage
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.geometry.linalg import norm, unit
from torchgrasp.scene.image import DepthImage, find_nearest
from torchgrasp.scene.scene import Scene


@dataclasses.dataclass(frozen=True)
class OccupancyNumbers:
    """Parameters of the voxel map of the space around the target."""

    spacing: float = 0.005
    """Spacing [m] of the voxels: a third of a finger's width."""
    sideways: float = 0.25
    """Horizontal distance [m] by which the voxels extend beyond the target's points."""
    above: float = 0.04
    """Height [m] by which the voxels extend above the highest point over the area that they cover.
    """
    noise: float = 0.004
    """Distance [m] in front of a measured depth beyond which space is free: three deviations of the
    noise.
    """
    low: float = 0.01
    """Height [m] above the table below which unlabelled pixels show the table."""
    rim: int = 6
    """Distance [px] from the target's pixels within which unlabelled pixels may be the target's:
    masks are off.
    """
    rim_depth: float = 0.02
    """Greatest difference of depth [m] from the target of the unlabelled pixels near it (`rim`)."""
    flying: int = 20
    """Least number of connected unlabelled pixels of an object; fewer are flying pixels."""
    gap: int = 8
    """Distance [px] from measured pixels within which pixels without depth are filled."""
    first: float = 0.02
    """Quantile of an object's points at which its extent begins."""
    last: float = 0.98
    """Quantile of an object's points at which its extent ends."""
    least: float = 0.002
    """Least probability that a hidden voxel is occupied."""


OCCUPANCY = OccupancyNumbers()
MODEL = Path(__file__).with_name("occupancy.json")
"""File with the knots and weights of the occupancy model, and with the data to which they were
fitted.
"""


@checked
@dataclasses.dataclass(frozen=True)
class Occupancy(Value):
    """The probability that something else occupies each voxel around a target, from
    `estimate_occupancy`.

    "Something else" means neither the target nor the table. The grid has x by y by z voxels.

    Attributes:
        origin: centre (3,) [m] of voxel (0, 0, 0), in the frame of the scene that
            `estimate_occupancy` was given. Its z axis must point up (`Scene.to_upright`).
        spacing: distance [m] between neighbouring centres. Voxel (i, j, k) has its centre at
            `origin` + (i, j, k) * `spacing`.
        probability: probability (x, y, z) of each voxel, in [0, 1].

    >>> free = Occupancy(torch.zeros(3), 0.01, torch.zeros(2, 3, 4))
    >>> free.centres[-1, -1, -1]
    tensor([0.0100, 0.0200, 0.0300], dtype=torch.float64)
    """

    origin: Float[Tensor, "3"]
    spacing: float
    probability: Float[Tensor, "x y z"]

    @property
    def centres(self) -> Float[Tensor, "x y z 3"]:
        """The centres (x, y, z, 3) [m] of the x by y by z voxels, in the frame of `origin`."""
        steps = [
            torch.arange(n, dtype=torch.float64, device=self.origin.device) * self.spacing
            for n in self.probability.shape
        ]
        return torch.stack(torch.meshgrid(*steps, indexing="ij"), -1) + self.origin.double()


@dataclasses.dataclass(frozen=True)
class Shadows(Value):
    """A depth image, and the object that hides the space behind each of its pixels.

    Attributes:
        image: the image itself, with its camera.
        depth: its depth [m] with small gaps filled.
        owner: the label of the object, 0 for the table, or -1 where nothing was measured. Each
            object without label has another negative number.
        points: the measured point [m] of each pixel, in the frame of the image's pose; NaN where
            nothing was measured.
    """

    image: DepthImage
    depth: Float[Tensor, "h w"]
    owner: Int[Tensor, "h w"]
    points: Float[Tensor, "h w 3"]

    def look(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        """Return how far each of n points lies behind the measured depth, and its pixel's `owner`.

        The distance (n,) [m] is along the camera's ray, negative in front of the depth. The points
        [m] are in the frame to which the image's pose leads. A point outside the image has the
        owner -1, and its distance means nothing.
        """
        camera = apply(inverse(self.image.obj_from_camera.double()), points.double())
        x, y, z = camera.unbind(-1)
        (fx, _, cx), (_, fy, cy), _ = self.image.intrinsics.tolist()
        ahead = z > 0
        safe = torch.where(ahead, z, 1.0)
        column = torch.round(fx * x / safe + cx).long()
        row = torch.round(fy * y / safe + cy).long()
        height, width = self.depth.shape
        seen = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = torch.where(seen, row * width + column, 0)
        owner = torch.where(seen, self.owner.reshape(-1)[pixel], -1)
        deeper = z - self.depth.reshape(-1)[pixel]
        behind = deeper * norm(camera) / safe
        return behind, owner


def cast_shadows(scene: Scene, target: int) -> Shadows:
    """Return the depth image of a scene, with the object that hides the space behind each pixel.

    The scene is in an upright frame with its table at z = 0. `target` is the label of an object;
    unlabelled pixels within 6 px and 20 mm of it are taken as its own (`OCCUPANCY.rim`).
    """
    image = scene.image
    row, column = scene.pixels.unbind(-1)
    depth = image.depth.double()
    owner = torch.full(image.depth.shape, -1, dtype=torch.int64)
    points = depth.new_full((*depth.shape, 3), torch.nan)
    points[row, column] = scene.points.double()
    owner[row, column] = scene.labels
    own = owner == target
    if scene.table is not None:
        loose = (owner == 0) & (points[..., 2] > OCCUPANCY.low)
        gap, nearest = find_nearest(own)
        # unlabelled pixels near the target's, in the image and in depth, are its own
        step = (depth - depth.reshape(-1)[nearest]).abs()
        rim = loose & (gap <= OCCUPANCY.rim) & (step <= OCCUPANCY.rim_depth)
        numbered: Any = ndimage.label((loose & ~rim).numpy())
        parts = torch.from_numpy(numbered[0]).long()
        large = (torch.bincount(parts.reshape(-1)) >= OCCUPANCY.flying)[parts]
        owner = torch.where(loose, torch.where(large, -1 - parts, -1), owner)
        owner = torch.where(rim, target, owner)
    gap, nearest = find_nearest(owner != -1)
    near = gap <= OCCUPANCY.gap
    depth = torch.where(near, depth.reshape(-1)[nearest], depth)
    owner = torch.where(near, owner.reshape(-1)[nearest], owner)
    return Shadows(image, depth, owner, points)


def shadow_features(
    shadows: Shadows, owner: int, points: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 6"]:
    """Return the six features by which a model predicts whether something occupies hidden points.

    The points are behind an object of the depth image. `points` (n, 3) [m] are in the upright frame
    of the scene, with z up; `owner` is the object's number in `shadows`. The features are, in
    order:

    * The depth of the point behind the object's surface, divided by the object's width.
    * The depth [m] of the point below the object's visible points in the same vertical column.
    * Two distances [m] of the mirrored point behind the measured depth, for two guesses of the
      object's middle.
    * The point's distance from the object's front, divided by the object's visible depth.
    * The point's distance from the object's middle, divided by the object's width.
    """
    own = shadows.points[(shadows.owner == owner) & torch.isfinite(shadows.points[..., 2])]
    # (n, 2): along the view, and across it
    toward = unit(shadows.image.obj_from_camera[:2, 3].double() - own[:, :2].mean(0))
    axes = torch.stack([toward, torch.stack([-toward[1], toward[0]])], -1)
    seen = own[:, :2] @ axes
    level = points[:, :2].double() @ axes
    ends = seen.new_tensor([OCCUPANCY.first, OCCUPANCY.last])
    low, high = torch.quantile(seen, ends, dim=0)
    deep, wide = (high - low + OCCUPANCY.spacing).tolist()
    front = high[0]
    middle = (low[1] + high[1]) / 2

    def mirrored(size: float) -> Float[Tensor, "n"]:
        centre = axes @ torch.stack([front - size / 2, middle])
        other = torch.cat([2 * centre - points[:, :2], points[:, 2:]], -1)
        return shadows.look(other)[0]

    behind, _ = shadows.look(points)
    under = _tops(own, points[:, :2].double()) - points[:, 2]
    across = (level[:, 1] - middle).abs() / wide
    along = (front - level[:, 0]) / deep
    mirrors = mirrored(deep), mirrored(max(deep, wide))
    return torch.stack([behind / wide, under, *mirrors, along, across], -1)


def _tops(own: Float[Tensor, "m 3"], places: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
    """Return the height [m] of an object's points in the column of each place; -1 outside."""
    corner = torch.floor(own[:, :2].amin(0) / OCCUPANCY.spacing).long() - 1
    count = torch.floor(own[:, :2].amax(0) / OCCUPANCY.spacing).long() - corner + 2

    def column(xy: Float[Tensor, "n 2"]) -> Int[Tensor, "n"]:
        # outside, a cell of the empty border
        cell = (torch.floor(xy / OCCUPANCY.spacing).long() - corner).clamp_min(0)
        cell = torch.minimum(cell, count - 1)
        return cell[:, 0] * count[1] + cell[:, 1]

    top = own.new_full((int(count[0] * count[1]),), -1.0)
    top.scatter_reduce_(0, column(own[:, :2]), own[:, 2], "amax")
    grid = ndimage.maximum_filter(top.reshape(count.tolist()).numpy(), 3)
    return torch.from_numpy(grid).reshape(-1)[column(places)]


@functools.cache
def load_occupancy_model() -> dict[str, Any]:
    """Return the fitted models of how likely hidden space is occupied, one for each kind of space.

    Their names are "target", "thing" and "unseen". These are the spaces behind the target, behind
    another object, and where nothing was measured. A model is a dict: "bias" is a number, "knots"
    and "values" hold one list for each feature. The log-odds are "bias" plus one function of each
    feature, linear between its knots, where it has its values.
    """
    return json.loads(MODEL.read_text("utf-8"))


def probability(kind: str, features: Float[Tensor, "n f"]) -> Float[Tensor, "n"]:
    """Return the probability that something else than the target occupies each of n hidden points.

    Its log-odds are a sum of piecewise linear functions, one of each of f features. `kind` says
    where the points are hidden. "thing", behind another object, has the features of
    `shadow_features`. "target", behind the target, has the depth [m] behind its surface and the
    height z [m]. "unseen", where nothing was measured, has the height z [m].
    """
    model = load_occupancy_model()[kind]
    odds = torch.full_like(features[:, 0], model["bias"])
    for x, knots, values in zip(features.unbind(-1), model["knots"], model["values"], strict=True):
        odds += torch.from_numpy(np.interp(x.numpy(), knots, values)).to(odds)
    return torch.sigmoid(odds).clamp_min(OCCUPANCY.least)


@checked
def estimate_occupancy(scene: Scene, target: int) -> Occupancy:
    """Return the probability that something else occupies each voxel around the target.

    "Something else" means neither the target nor the table. Space in front of a measured depth is
    free. Behind another object, a fitted model estimates the probability. Behind the target and
    where nothing was measured, it is a rough guess.

    The voxels have a side of 5 mm (`OCCUPANCY.spacing`), and extend 0.25 m (`OCCUPANCY.sideways`)
    around the target. They reach from the table to 0.04 m (`OCCUPANCY.above`) above the highest
    measured point of an object in this area. Without a table they begin at the lowest such point.
    The probabilities are float64 on the scene's device, but computed on the CPU.

    Args:
        scene: the scene in a frame with z up, as `Scene.to_upright` returns it. Its table, if it
            is known, is at z = 0.
        target: label of the target.

    Raises `BadArgument` for a label without points.

    >>> from torchgrasp import load_scene
    >>> found = estimate_occupancy(load_scene(), target=1)
    >>> bool((found.probability > 0.5).any()), bool((found.probability < 0.01).any())
    (True, True)
    """
    device = scene.points.device
    scene = settle(scene, torch.device("cpu"))
    if not scene.rows_of(target).any():
        raise BadArgument("target", target, f"one of the labels {scene.things}")
    things = scene.labels > 0
    if scene.table is not None:
        things = (scene.points[:, 2] > OCCUPANCY.low) | scene.rows_of(target)
    points = scene.points[scene.rows_of(target)].double()
    others = scene.points[things].double()
    low = points.amin(0) - OCCUPANCY.sideways
    high = points.amax(0) + OCCUPANCY.sideways
    near = ((others >= low) & (others <= high))[:, :2].all(1)
    low[2] = 0.0 if scene.table is not None else float(others[near, 2].min())
    high[2] = float(others[near, 2].max()) + OCCUPANCY.above
    origin = (torch.floor(low / OCCUPANCY.spacing) + 0.5) * OCCUPANCY.spacing
    shape = torch.ceil((high - origin) / OCCUPANCY.spacing).long().tolist()
    empty = Occupancy(origin, OCCUPANCY.spacing, torch.zeros(shape, dtype=torch.float64))
    centres = empty.centres.reshape(-1, 3)
    shadows = cast_shadows(scene, target)
    behind, owner = shadows.look(centres)
    inside = (owner != 0) & (behind > -OCCUPANCY.noise)
    hidden = flatnonzero((owner == -1) | inside)
    whose = owner[hidden]
    full = empty.probability.reshape(-1)
    for thing in whose.unique().tolist():
        rows = hidden[whose == thing]
        where = centres[rows]
        depth = behind[rows]
        if thing == -1:
            full[rows] = probability("unseen", where[:, 2:])
        elif thing == target:
            full[rows] = probability("target", torch.stack([depth, where[:, 2]], -1))
        else:
            full[rows] = probability("thing", shadow_features(shadows, thing, where))
    return settle(empty, device)
