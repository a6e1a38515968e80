"""A scene as its camera would see it once an object is taken away."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.foundation.base import settle
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.plane import Plane
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.occupancy import cast_shadows
from torchgrasp.scene.scene import Scene


def take_away(scene: Scene, label: int) -> Scene:
    """Return the scene without an object: its pixels show the table behind it.

    Where the table is not behind a pixel, or is unknown, the depth counts as not measured. What the
    object hides stays unseen: a target behind it shows no more of itself. Raises `BadArgument` for
    the target and for a label of no object.
    """
    device = scene.points.device
    scene = settle(scene, torch.device("cpu"))
    others = [k for k in scene.things if k != scene.target]
    if label not in others:
        raise BadArgument("label", label, f"the label of an object beside the target: {others}")
    image = scene.image
    # unlabelled pixels at the object's rim go with it
    gone = cast_shadows(scene, label).owner == label
    depth = torch.where(gone, _depth_of(scene.table, image), image.depth.double())
    shown = dataclasses.replace(image, depth=depth.to(image.depth))
    row, column = scene.pixels.unbind(-1)
    changed = gone[row, column] & (scene.labels != scene.target)
    points = torch.where(changed[:, None], shown.points()[row, column], scene.points.double())
    kept = ~changed | (depth[row, column] > 0)
    found = dataclasses.replace(
        scene,
        points=points[kept].to(scene.points),
        labels=torch.where(changed, 0, scene.labels)[kept],
        pixels=scene.pixels[kept],
        image=shown,
        given=tuple(k for k in scene.given if k != label),
    )
    return settle(found, device)


def _depth_of(table: Plane | None, image: DepthImage) -> Float[Tensor, "h w"]:
    """Return the depth [m] at which each pixel would show the table; 0 where it would not."""
    if table is None:
        return torch.zeros_like(image.depth, dtype=torch.float64)
    falls = -(image.rays() @ table.normal.double())
    meets: Bool[Tensor, "h w"] = falls > 0
    depth = table.height(image.obj_from_camera[:3, 3].double()) / torch.where(meets, falls, 1.0)
    return torch.where(meets, depth, 0.0)
