"""Whether a hand can grasp an object of a scene, and how easily, judged from the depth image before
planning.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.cloud.check import FEW_POINTS
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.plane import to_upright, upright_frame
from torchgrasp.geometry.support_planes import find_table
from torchgrasp.hand.hand import Hand
from torchgrasp.scene.scene import Scene
from torchgrasp.scene.segment import SEGMENT
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.success.order import largest_known
from torchgrasp.values.specs import FLAT_RADII, TIP_RADIUS, ContactSpec


@checked
def judge_things(scene: Scene, hand: Hand, spec: ContactSpec | None = None) -> dict[int, Status]:
    """Return for each object's label the first reason why the hand cannot grasp the object, or
    `Status.OK`.

    The objects are judged from the depth image alone, without planning, in milliseconds.

    >>> from torchgrasp import load_hand, load_scene
    >>> set(judge_things(load_scene(), load_hand("barrett")).values()) == {Status.OK}
    True
    """
    if not scene.things:
        return {}
    spec = (ContactSpec() if spec is None else spec).for_fingertips(float(hand.tips.radius.max()))
    span = hand_span(hand)
    points, labels = _stand_upright(scene)
    found = {
        label: _judge(scene, points[labels == label], label, spec, span) for label in scene.things
    }
    if scene.table is not None:
        support = find_table(scene.points, scene.viewpoint, scene.table, None)[0]
        over = support.covers(scene.points[scene.labels > 0].cpu().double(), SEGMENT.overhang)
        off = {
            label: Status.OFF_TABLE
            for label in found
            if not bool(over[labels == label].double().mean() > 0.5)
        }
        found |= {
            label: status for label, status in off.items() if found[label] is not Status.FEW_PIXELS
        }
    return found


def _judge(
    scene: Scene, points: Float[Tensor, "n 3"], label: int, spec: ContactSpec, span: float
) -> Status:
    """Return the first reason why a hand of this `span` [m] cannot grasp an object; `points` have z
    up.
    """
    pixels = scene.pixels[scene.labels == label].cpu()
    bounded = scene.image.bounded
    if len(pixels) < FEW_POINTS:
        return Status.FEW_PIXELS
    if bounded and _is_cut(pixels, scene.image.depth.shape):
        return Status.CUT_OFF
    if bounded and _is_see_through(pixels, scene.image.depth):
        return Status.NO_DEPTH
    top, higher = points[:, 2].quantile(torch.tensor([0.98, 0.9]).to(points)).tolist()
    if scene.table is not None and higher < spec.least_height:
        return Status.TOO_LOW
    above = points[points[:, 2] > top - 2 * spec.fingertip_radius, :2]
    return Status.TOO_WIDE if _thickness(above, spec.fingertip_radius / 2) > span else Status.OK


def _stand_upright(scene: Scene) -> tuple[Float[Tensor, "n 3"], Int[Tensor, "n"]]:
    """Return the points of all objects in the upright frame [m], and their labels."""
    points, labels = (x[scene.labels > 0].cpu() for x in (scene.points, scene.labels))
    return to_upright(points, upright_frame(points, scene.viewpoint, scene.table)), labels


def _is_cut(pixels: Tensor, shape: tuple[int, ...]) -> bool:
    """Return whether the image border cuts an object: it is longer along the border than it extends
    into the image.
    """
    for axis in (0, 1):
        for depth in (pixels[:, axis], shape[axis] - 1 - pixels[:, axis]):
            along = pixels[depth <= 1, 1 - axis]
            if len(along) >= 5 and int(along.max() - along.min()) > int(
                depth.max()
            ):  # fewer pixels are noise
                return True
    return False


def _is_see_through(pixels: Tensor, depth: Float[Tensor, "h w"]) -> bool:
    """Return whether an object mostly lacks depth, as glass does: more gaps than pixels lie within
    its outline.
    """
    own = np.zeros(depth.shape, dtype=bool)
    box = tuple(slice(int(x.min()), int(x.max()) + 1) for x in pixels.T)
    own[tuple(pixels.T.numpy())] = True
    part = own[box]
    reach = np.logical_or.accumulate
    down = reach(part, 0) & reach(part[::-1], 0)[::-1]
    right = reach(part, 1) & reach(part[:, ::-1], 1)[:, ::-1]
    return int(((down | right) & (depth[box].cpu().numpy() == 0)).sum()) > len(pixels)


def _thickness(points: Float[Tensor, "n 2"], cell: float) -> float:
    """Return the diameter [m] of the largest disc in the area that points fill, on a grid with this
    `cell` side [m].
    """
    from scipy.ndimage import binary_closing, distance_transform_edt

    place = torch.floor((points - points.amin(0)) / cell).long().numpy() + 2
    filled = np.zeros(place.max(0) + 3, dtype=bool)
    filled[tuple(place.T)] = True
    inside = np.asarray(distance_transform_edt(binary_closing(filled, np.ones((3, 3)))))
    return (2 * float(inside.max()) - 1) * cell


def hand_span(hand: Hand) -> float:
    """Return the widest grasp [m]: the largest distance of two pads that face each other, over
    random postures.
    """
    if "span" not in hand.derived:
        draw = torch.rand(
            5000,
            hand.dof,
            generator=torch.Generator().manual_seed(0),
            dtype=torch.float64,
            device="cpu",
        )
        pads, normals = hand.fingertips(
            hand.lower + draw.to(hand.lower) * (hand.upper - hand.lower)
        )
        way = pads[:, None] - pads[:, :, None]
        distance = torch.linalg.vector_norm(way, dim=-1)
        cosine = (normals[:, :, None] * way).sum(-1) / distance.clamp_min(1e-9)
        facing = cosine >= hand.tips.cone.cos()[:, None]
        hand.derived["span"] = float(
            torch.where(facing & facing.transpose(1, 2), distance, 0.0).max()
        )
    return hand.derived["span"]


def is_vague(shape: ShapeGP) -> bool:
    """Return whether the standard deviation somewhere on the estimated surface exceeds half the
    object's size.
    """
    return float(extract_surface(shape, 24).std_m.quantile(0.99)) > shape.scale


def order_by_ease(scene: Scene) -> list[int]:
    """Return the labels of a scene's objects, the easiest to grasp first.

    An object is easy if it is tall, has free space around it, and has nothing above it. The camera
    should be so near that a pixel on the object is smaller than a contact, and should see more of
    the object than fingertips cover. The object's outline in the image should be convex; otherwise
    it may be partly hidden, or be two objects that touch. Objects that are larger than all objects
    in our trials, or that the image border cuts off, come last.
    """
    from scipy.spatial import ConvexHull, KDTree

    # [m] more room or height makes nothing easier; side of a column of points
    room = 0.06
    height = 0.08
    side = 0.01
    points, labels, rank = *(x.numpy() for x in _stand_upright(scene)), {}
    cells = np.floor(points / (side / 2)).astype(np.int64)
    some = np.unique(
        ((cells + 2**15) @ (1, 2**16, 2**32)) * (labels.max(initial=0) + 1) + labels,
        return_index=True,
    )[1]
    points = points[some]
    labels = labels[some]
    column = (cells[some, :2] // 2) @ (1, 2**16)
    column = np.unique(column, return_inverse=True)[1]
    for label in scene.things:
        own = points[labels == label]
        others = labels != label
        near = others & (np.abs(points - own.mean(0)) < np.ptp(own, 0) + room).all(1)
        gap = (
            KDTree(points[near]).query(own, distance_upper_bound=room)[0].min()
            if near.any()
            else room
        )
        top = np.full(column.max() + 1, np.inf)
        np.minimum.at(top, column[labels == label], own[:, 2])
        above = np.unique(column[others & (points[:, 2] > top[column] + side)])
        covered = len(above) / len(np.unique(column[labels == label]))
        own_height = np.quantile(own[:, 2], 0.95) if scene.table is not None else height
        pixels = scene.pixels[scene.rows_of(label)]
        pixel = float(scene.image.depth[tuple(pixels.T)].median()) / float(
            scene.image.intrinsics[0, 0]
        )
        seen = len(pixels) * pixel**2 / (3 * math.pi * TIP_RADIUS**2)
        convex = (
            len(pixels) / ConvexHull(pixels.cpu().numpy(), qhull_options="QJ").volume
            if len(pixels) > 2
            else 0.0
        )
        clear = min(FLAT_RADII[0] / pixel, 1.0) + min(seen, 1.0) + min(convex, 1.0)
        ease = (
            min(gap / room, 1.0) + min(own_height / height, 1.0) - min(5.0 * covered, 1.0) + clear
        )
        radius = np.linalg.norm(own - (own.min(0) + own.max(0)) / 2, axis=1).max()
        rank[label] = (radius > largest_known() or scene.image.at_border(pixels), -ease)
    return sorted(rank, key=rank.__getitem__)
