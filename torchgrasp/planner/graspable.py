"""Whether a hand can grasp an object of a scene, and how easily, judged from the depth image before
planning.
"""

import dataclasses
import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.cloud.check import FEW_POINTS
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.foundation.lazy import ndimage, spatial
from torchgrasp.geometry.linalg import norm
from torchgrasp.geometry.plane import to_upright, upright_frame
from torchgrasp.geometry.support_search import find_table
from torchgrasp.hand.hand import Hand
from torchgrasp.scene.image import IMAGE
from torchgrasp.scene.scene import Scene
from torchgrasp.scene.segment import SEGMENT
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import extract_surface
from torchgrasp.success.order import largest_known
from torchgrasp.values.specs import FLAT_RADII, TIP_RADIUS, ContactSpec


@dataclasses.dataclass(frozen=True)
class JudgeNumbers:
    """Bounds on the points and pixels of an object beyond which a hand cannot grasp it."""

    on_support: float = 0.5
    """Least share of an object's points that are over its support."""
    top: float = 0.98
    """Quantile of the heights of an object's points that counts as its top."""
    high: float = 0.9
    """Quantile of the heights of an object's points that must be high enough above the table for
    fingertips.
    """


@dataclasses.dataclass(frozen=True)
class SpanNumbers:
    """Parameters of the search for the span of a hand, in random postures."""

    postures: int = 5000
    """Number of random postures in which the span of a hand is sought."""
    least_distance: float = 1e-9
    """Least distance [m] of two pads, so that no division is by 0."""


@dataclasses.dataclass(frozen=True)
class VagueNumbers:
    """Parameters by which an estimated shape is judged too uncertain (vague) to be grasped."""

    cells: int = 24
    """Number of cells along a side of the grid on which the surface is extracted."""
    worst: float = 0.99
    """Quantile of the standard deviations on a surface that counts as the largest."""


@dataclasses.dataclass(frozen=True)
class EaseNumbers:
    """Parameters of the order in which the objects of a scene are planned."""

    room: float = 0.06
    """Free space [m] around an object above which more space does not raise the object's rank."""
    height: float = 0.08
    """Height [m] of an object above which a larger height does not raise the object's rank."""
    side: float = 0.01
    """Side [m] of the vertical columns in which points are counted."""
    top: float = 0.95
    """Quantile of the heights of an object's points that counts as its height."""
    covered: float = 5.0
    """Weight of the share of an object's columns that have something above them. The product counts
    as at most 1.
    """
    columns: int = 2**16
    """Number of cells of the grid along an axis, of which half are at negative coordinates."""


JUDGE = JudgeNumbers()
SPAN = SpanNumbers()
VAGUE = VagueNumbers()
EASE = EaseNumbers()


@checked
def judge_things(scene: Scene, hand: Hand, spec: ContactSpec | None = None) -> dict[int, Status]:
    """Return for the label of each object of a scene why the hand cannot grasp it, or `Status.OK`.

    The objects are judged from the depth image alone, without planning, in milliseconds. The first
    reason that holds is returned. The reasons are: few pixels (`FEW_PIXELS`), not over the table
    (`OFF_TABLE`), cut off by the image's border (`CUT_OFF`), mostly without depth (`NO_DEPTH`). The
    object may also be too low for the fingertips (`TOO_LOW`), or wider than the hand spans
    (`TOO_WIDE`). `spec` holds the constraints on contacts; None means `ContactSpec()`.

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
        for label, status in found.items():
            share = float(over[labels == label].double().mean())
            if status is not Status.FEW_PIXELS and not share > JUDGE.on_support:
                found[label] = Status.OFF_TABLE
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
    parts = torch.tensor([JUDGE.top, JUDGE.high], dtype=torch.float32).to(points)
    top, high = points[:, 2].quantile(parts).tolist()
    if scene.table is not None and high < spec.least_height:
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
            if len(along) < IMAGE.border_pixels:
                continue
            if int(along.max() - along.min()) > int(depth.max()):
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
    gaps = (down | right) & (depth[box].cpu().numpy() == 0)
    return int(gaps.sum()) > len(pixels)


def _thickness(points: Float[Tensor, "n 2"], cell: float) -> float:
    """Return the diameter [m] of the largest disc in the area that points fill, on a grid with this
    `cell` side [m].
    """
    place = torch.floor((points - points.amin(0)) / cell).long().numpy() + 2
    filled = np.zeros(place.max(0) + 3, dtype=bool)
    filled[tuple(place.T)] = True
    closed = ndimage.binary_closing(filled, np.ones((3, 3)))
    inside = np.asarray(ndimage.distance_transform_edt(closed))
    return (2 * float(inside.max()) - 1) * cell


def hand_span(hand: Hand) -> float:
    """Return the span [m] of a hand: the largest distance of two fingertip pads that face each
    other.

    A pad may touch within a cone about its normal. Pads face each other if the line between them
    lies in both cones. The span is found among random postures, the same in every call.
    """
    if "span" not in hand.derived:
        generator = torch.Generator().manual_seed(0)
        size = (SPAN.postures, hand.dof)
        draw = torch.rand(*size, generator=generator, dtype=torch.float64, device="cpu")
        joints = hand.lower + draw.to(hand.lower) * (hand.upper - hand.lower)
        pads, normals = hand.fingertips(joints)
        # (b, f, f, 3): from each pad to each other
        way = pads[:, None] - pads[:, :, None]
        distance = norm(way)
        cosine = (normals[:, :, None] * way).sum(-1) / distance.clamp_min(SPAN.least_distance)
        facing = cosine >= hand.tips.cone.cos()[:, None]
        mutual = facing & facing.transpose(1, 2)
        hand.derived["span"] = float(torch.where(mutual, distance, 0.0).max())
    return hand.derived["span"]


def is_vague(shape: ShapeGP) -> bool:
    """Return whether an estimated shape is too uncertain to plan with.

    It is if the 99 % quantile (`VAGUE.worst`) of the standard deviation [m] on its surface exceeds
    half the object's size (`shape.scale`).
    """
    return float(extract_surface(shape, VAGUE.cells).std_m.quantile(VAGUE.worst)) > shape.scale


def order_by_ease(scene: Scene) -> list[int]:
    """Return the labels of a scene's objects, the easiest to grasp first.

    An object is easy if it is tall, has free space around it, and has nothing above it. The camera
    should be so near that a pixel on the object is smaller than a contact. It should see more of
    the object than fingertips cover. The object's outline in the image should be convex. Otherwise
    it may be partly hidden, or be two objects that touch. Objects that the image border cuts off
    come last. So do objects larger than any in the trials from which success is predicted.
    """
    points, labels = (x.numpy() for x in _stand_upright(scene))
    # one point of each object in a cell is enough
    cells = np.floor(points / (EASE.side / 2)).astype(np.int64)
    places = (cells + EASE.columns // 2) @ (1, EASE.columns, EASE.columns**2)
    some = np.unique(places * (labels.max(initial=0) + 1) + labels, return_index=True)[1]
    points = points[some]
    labels = labels[some]
    column = (cells[some, :2] // 2) @ (1, EASE.columns)
    column = np.unique(column, return_inverse=True)[1]
    rank = dict[int, tuple[bool, float]]()
    for label in scene.things:
        mine = labels == label
        own = points[mine]
        height = EASE.height if scene.table is None else np.quantile(own[:, 2], EASE.top)
        free = min(_free_space(points, mine) / EASE.room, 1.0) + min(height / EASE.height, 1.0)
        covered = min(EASE.covered * _covered(points, mine, column), 1.0)
        pixels = scene.pixels[scene.rows_of(label)]
        ease = free - covered + _clarity(scene, pixels)
        radius = np.linalg.norm(own - (own.min(0) + own.max(0)) / 2, axis=1).max()
        last = radius > largest_known() or scene.image.at_border(pixels)
        rank[label] = (last, -ease)
    return sorted(rank, key=rank.__getitem__)


def _free_space(points: np.ndarray, mine: np.ndarray) -> float:
    """Return the least distance [m] of an object from others, at most `EASE.room`.

    `points` (n, 3) [m] are those of all objects, and `mine` is a mask of the object's own.
    """
    own = points[mine]
    beside = np.abs(points - own.mean(0)) < np.ptp(own, 0) + EASE.room
    near = ~mine & beside.all(1)
    if not near.any():
        return EASE.room
    return spatial.KDTree(points[near]).query(own, distance_upper_bound=EASE.room)[0].min()


def _covered(points: np.ndarray, mine: np.ndarray, column: np.ndarray) -> float:
    """Return the share of an object's columns that have something above them.

    `column` (n,) is the index of each point's column. The other arguments are those of
    `_free_space`.
    """
    # the lowest point of the object in each column: what is clearly higher lies above it
    top = np.full(column.max() + 1, np.inf)
    np.minimum.at(top, column[mine], points[mine, 2])
    above = np.unique(column[~mine & (points[:, 2] > top[column] + EASE.side)])
    return len(above) / len(np.unique(column[mine]))


def _clarity(scene: Scene, pixels: Int[Tensor, "n 2"]) -> float:
    """Return how clearly the camera sees an object of these pixels, from 0 to 3.

    Pixels should be small beside a contact, cover more than the fingertips, and have a convex
    outline.
    """
    pixel = float(scene.image.depth[tuple(pixels.T)].median()) / scene.image.focal
    seen = len(pixels) * pixel**2 / (3 * math.pi * TIP_RADIUS**2)
    convex = 0.0
    if len(pixels) > 2:
        outline = spatial.ConvexHull(pixels.cpu().numpy(), qhull_options="QJ")
        convex = len(pixels) / outline.volume
    return min(FLAT_RADII[0] / pixel, 1.0) + min(seen, 1.0) + min(convex, 1.0)
