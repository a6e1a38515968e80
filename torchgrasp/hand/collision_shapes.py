"""Collision shapes of a hand's links: covering spheres, exact boxes, and the pairs of links that
can collide.

Spheres give the clearance from object and table. Each collision shape is cut into cells, with one
sphere for each cell. No surface with a radius of curvature above 25 mm reaches a face between the
spheres. Exact boxes and spheres are tested for self-collision; in this test a cylinder becomes a
prism of twelve sides. A posture is one position of all joints.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import Value, check_whole
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.limits import HAND_SEPARATIONS, HAND_SHAPE_PAIRS
from torchgrasp.geometry.frames import real, rotation_from_rpy
from torchgrasp.hand.hand_toml import HandSpec
from torchgrasp.hand.kinematics import Frames, tree_from_urdf
from torchgrasp.hand.self_collision import SelfCollision
from torchgrasp.hand.urdf import LinkShape, Mimic, Triple, Urdf

MEETING_DISTANCE = 0.002  # links that come nearer than this [m] in some posture are a pair to test
MOST_POSTURES = 10**7  # most postures that may be asked for
LOOK = 1000  # postures after which settled pairs are left out
SEPARATIONS = 100_000  # separations that are computed at a time, which bounds the memory
# links that overlap in a larger share of the postures overlap by construction: they are no pair to
# test
ALWAYS = 0.98


@dataclasses.dataclass(frozen=True)
class CoverNumbers:
    """Parameters of the spheres that cover a hand for collision checks."""

    finger_cell: float = 0.015
    """Edge [m] of the cells into which shapes of a finger are cut, each covered by a sphere. If
    larger, the corners of a shape protrude farther from its spheres.
    """
    palm_cell: float = 0.022
    """Edge [m] of the cells into which shapes of the palm are cut."""
    bulge: float = 0.004
    """Distance [m] by which a sphere may protrude from a shape's faces, other than a
    fingertip's."""
    single_layer: float = 0.025
    """Thickness [m] of a shape below which it has one layer of cells across."""
    sunk: float = 0.001
    """Distance [m] by which a cell's corners may protrude from its sphere."""


COVER = CoverNumbers()


@dataclasses.dataclass(frozen=True)
class CollisionSpheres(Value):
    """The s spheres that cover the links of a hand; a `Hand` holds them as `collision_spheres`.

    Attributes:
        link_index: index (s,) of the link of each sphere, in `Hand.tree.link_names`.
        center: centre (s, 3) [m] of each sphere, in the frame of its link.
        radius: radius (s,) [m] of each sphere.
        finger: index (s,) in `Hand.finger_names` of the finger of each sphere. It is -1 for the
            palm, and -2 for a finger that does not grasp.
        touching: mask (s,) of the spheres on the links of the grasping fingertips, which may touch
            objects.

    >>> from torchgrasp import load_hand
    >>> load_hand("barrett").collision_spheres.center.shape
    torch.Size([117, 3])
    """

    link_index: Int[Tensor, " s"]
    center: Float[Tensor, "s 3"]
    radius: Float[Tensor, " s"]
    finger: Int[Tensor, " s"]
    touching: Bool[Tensor, " s"]


def spheres_from_urdf(urdf: Urdf, spec: HandSpec) -> CollisionSpheres:
    """Return spheres that cover every collision shape of a hand's URDF.

    `spec` is the content of hand.toml, which names the grasping fingers and their tips. Spheres of
    these tips do not protrude from the tip's faces; other spheres protrude by at most 4 mm
    (`COVER.bulge`).
    """
    owner = {joint: i for i, f in enumerate(spec.fingers) for joint in f.joints}
    tips = [f.tip_link for f in spec.fingers]
    rows: list[tuple[int, Triple, float, int, bool]] = []
    for index, link in enumerate(urdf.links):
        movers = urdf.movers(link.name)
        touching = link.name in tips
        finger = owner.get(movers[0].name, -2) if movers else -1
        cell = COVER.palm_cell if finger == -1 else COVER.finger_cell
        for shape in link.shapes:
            # a tip's contact is known exactly: no sphere may touch before it
            centers, radius = cover(shape, cell, 0.0 if touching else COVER.bulge)
            rows += [(index, center, radius, finger, touching) for center in centers]
    link_index, center, radius, finger, touching = zip(*rows, strict=True)
    own = functools.partial(torch.tensor, device="cpu")
    return CollisionSpheres(own(link_index), real(center), real(radius), own(finger), own(touching))


def cover(shape: LinkShape, cell: float, bulge: float) -> tuple[list[Triple], float]:
    """Return the centres [m] of spheres that cover a collision shape, then the radius [m] that all
    of them have.

    The centres are in the frame of the shape's link. The shape is cut into cells of about the edge
    `cell` [m], with a sphere for each outer cell. Each sphere is moved inward until it protrudes
    from a face by at most `bulge` [m]. A shape that is a sphere is its own cover.
    """
    if shape.kind == "sphere":
        return [shape.xyz], shape.size[0]
    size = [2 * x for x in shape.half]  # a cylinder is cut as its bounding box
    thin = min(size)
    single = [x == thin and x < COVER.single_layer for x in size]
    counts = [1 if one else max(1, round(x / cell)) for x, one in zip(size, single, strict=True)]
    cells = list(zip(size, counts, strict=True))
    half = [x / n / 2 for x, n in cells]
    thinnest = min((x / 2 for x, n in cells if n == 1), default=math.inf)
    radius = min(math.hypot(*half) - COVER.sunk, thinnest + bulge)
    centers = []
    for place in itertools.product(*(range(n) for n in counts)):
        if all(0 < c < n - 1 for c, n in zip(place, counts, strict=True)):
            continue  # an inner cell: the outer ones meet the object first
        center = [(2 * c + 1 - n) * h for c, n, h in zip(place, counts, half, strict=True)]
        # a sphere is pulled in until it stands out of a face by no more than the bulge
        reach = [max(0.0, s / 2 + bulge - radius) for s in size]
        center = [math.copysign(min(abs(c), r), c) for c, r in zip(center, reach, strict=True)]
        if shape.kind == "cylinder":
            rim = max(0.0, shape.size[0] + bulge - radius)
            out = math.hypot(center[0], center[1])
            if out > rim:
                center[:2] = [center[0] * rim / out, center[1] * rim / out]
        centers.append(center)
    placed = real(centers) @ rotation_from_rpy(shape.rpy).T + real(shape.xyz)
    return [(x, y, z) for x, y, z in placed.tolist()], radius


def self_collision_from_urdf(urdf: Urdf, pairs: Iterable[tuple[str, str]] | None) -> SelfCollision:
    """Return the collision shapes of a URDF's links, and the pairs of shapes to test for collision.

    `pairs` has the names of the two links of each pair to test; None means all pairs but a link and
    its parent. Shapes are boxes and spheres: a cylinder becomes six boxes. Raises `HandFileError`
    for more than 20,000 pairs of shapes.
    """
    names = [x.name for x in urdf.links]
    listed = itertools.combinations(names, 2) if pairs is None else pairs
    tested = {frozenset(pair) for pair in listed}
    if pairs is None:
        tested -= {frozenset((j.parent, j.child)) for j in urdf.joints}
    shapes = [
        (i, *part)
        for i, link in enumerate(urdf.links)
        for shape in link.shapes
        for part in _parts(shape)
    ]
    link, rotation, center, half, radius = zip(*shapes, strict=True)
    places = {i: list(of) for i, of in itertools.groupby(range(len(shapes)), link.__getitem__)}
    meeting = [
        (i, j)
        for i in places
        for j in places
        if j >= i and frozenset((names[i], names[j])) in tested
    ]
    many = sum(len(places[i]) * len(places[j]) for i, j in meeting)
    if many > HAND_SHAPE_PAIRS:
        found = f"{many} pairs of shapes to test for collisions"
        raise urdf.wrong(
            found, f"at most {HAND_SHAPE_PAIRS} pairs, where a cylinder counts as six shapes"
        )
    near = sorted(
        (one, two) for i, j in meeting for one in places[i] for two in places[j] if two > one
    )
    boxes = list[tuple[int, int]]()
    mixed = list[tuple[int, int]]()
    spheres = list[tuple[int, int]]()
    for one, two in near:
        if radius[one] > 0 and radius[two] > 0:
            spheres.append((one, two))
        elif radius[two] > 0:
            mixed.append((two, one))  # the sphere comes first
        else:
            (mixed if radius[one] > 0 else boxes).append((one, two))
    sorted_pairs = torch.tensor([*boxes, *mixed, *spheres], dtype=torch.long, device="cpu")
    return SelfCollision(
        link=torch.tensor(link, device="cpu"),
        rotation=torch.stack(rotation, -1),
        center=real(center),
        half=real(half),
        radius=real(radius),
        pairs=sorted_pairs.view(-1, 2),
        kinds=(len(boxes), len(mixed), len(spheres)),
    )


def _parts(shape: LinkShape) -> list[tuple[Float[Tensor, "3 3"], Triple, Triple, float]]:
    """Return rotation, centre, half sizes and radius [m] of each box or sphere of a shape; a
    cylinder is six boxes.
    """
    rotation = rotation_from_rpy(shape.rpy)
    if shape.kind == "sphere":
        return [(rotation, shape.xyz, (0.0, 0.0, 0.0), shape.size[0])]
    if shape.kind == "box":
        return [(rotation, shape.xyz, shape.half, 0.0)]
    boxes = 6
    step = math.pi / boxes
    radius, length = shape.size
    # as far outside the circle as the sides are inside
    corner = 2 * radius / (1 + math.cos(step / 2))
    half = (corner * math.cos(step / 2), corner * math.sin(step / 2), length / 2)
    return [
        (rotation @ rotation_from_rpy((0.0, 0.0, k * step)), shape.xyz, half, 0.0)
        for k in range(boxes)
    ]


def collision_pairs(
    urdf: Urdf, coupling: Mapping[str, Mimic], n: int = 20_000, seed: int = 0
) -> list[tuple[str, str]]:
    """Return the names of the two links of each pair that can collide, found in n random postures
    drawn from `seed`.

    The two links come nearer than 2 mm (`MEETING_DISTANCE`) in some posture. They overlap in at
    most 98 % of the postures (`ALWAYS`): links that always overlap do so by construction. A link
    and its parent are never a pair. `coupling` tells by name which joints follow others, and how.
    Raises `BadArgument` for unknown joints, or an `n` outside [1, 10^7]. Raises `HandFileError` if
    too many shapes are near each other.
    """
    check_whole("n", n, 1, MOST_POSTURES)
    tree = tree_from_urdf(urdf)
    shapes = self_collision_from_urdf(urdf, None)
    if not len(shapes.pairs):
        return []
    of_pairs = shapes.link[shapes.pairs].sort(1).values
    links, owner = torch.unique(of_pairs, dim=0, return_inverse=True)
    met, near = torch.zeros(2, len(links), dtype=torch.float64, device=links.device)
    done = 0
    for look in draw_postures(urdf, coupling, n, seed).split(LOOK, 1):
        if not len(owner):
            break
        size = max(1, SEPARATIONS // len(owner))
        chunks = [tree.frames(chunk) for chunk in look.split(size, 1)]
        if not done:
            _limit_near(urdf, shapes, chunks[0], look.shape[1], HAND_SEPARATIONS // 10)
        for frames in chunks:
            apart = shapes.separations(frames, MEETING_DISTANCE)
            least = apart.new_full((len(links), apart.shape[1]), torch.inf)
            least.scatter_reduce_(0, owner[:, None].expand_as(apart), apart, "amin")
            met += (least < 0).sum(1)
            near += (least < MEETING_DISTANCE).sum(1)
        done += look.shape[1]
        met[met >= done] = torch.inf  # links that overlapped in every posture so far
        # Whatever the rest shows.
        known = (near > 0) & (met + (n - done) <= ALWAYS * n)
        settled = (met == torch.inf) | known
        kept = ~settled[owner]
        shapes = shapes.only(kept)
        owner = owner[kept]
        _limit_near(urdf, shapes, chunks[0], n - done, HAND_SEPARATIONS)
    colliding = links[(near > 0) & (met <= ALWAYS * n)].tolist()
    return [(tree.link_names[i], tree.link_names[j]) for i, j in colliding]


def met_pairs(
    urdf: Urdf, pairs: Sequence[tuple[str, str]], postures: Float[Tensor, "j n"]
) -> Bool[Tensor, "p n"]:
    """Return a mask (p, n): whether the two links of each of p pairs overlap in each of n postures.

    `pairs` holds the names of the two links of each pair; a pair may occur twice. `postures` (j, n)
    are positions [rad or m] of all j movable joints, in the order of the URDF.
    """
    tree = tree_from_urdf(urdf)
    shapes = self_collision_from_urdf(urdf, pairs)
    met = torch.zeros(len(pairs), postures.shape[1], dtype=torch.long, device="cpu")
    if not len(shapes.pairs):
        return met > 0
    index = {frozenset(pair): row for row, pair in enumerate(pairs)}
    rows = [
        index[frozenset(tree.link_names[k] for k in both)]
        for both in shapes.link[shapes.pairs].tolist()
    ]
    owner = torch.tensor(rows, device="cpu")
    size = max(1, SEPARATIONS // len(owner))
    for chunk, count in zip(postures.split(size, 1), met.split(size, 1), strict=True):
        apart = shapes.separations(tree.frames(chunk), 0.0)  # (pairs of shapes, n)
        count.index_add_(0, owner, (apart < 0).long())
    # a pair that occurs twice was counted in its last row
    return (met > 0)[[index[frozenset(pair)] for pair in pairs]]


def _limit_near(urdf: Urdf, shapes: SelfCollision, frames: Frames, ahead: int, most: int) -> None:
    """Raise `HandFileError` if `ahead` postures like those of `frames` need more than `most`
    measured separations.
    """
    left = shapes.count_near(frames, MEETING_DISTANCE) * ahead // frames.shape[3]
    if left > most:
        found = (
            f"{len(shapes.pairs)} pairs of shapes so near each other that {left} separations "
            "must be measured"
        )
        raise urdf.wrong(found, f"at most {most} separations, by fewer shapes in one place")


def draw_postures(
    urdf: Urdf, coupling: Mapping[str, Mimic], n: int, seed: int
) -> Float[Tensor, "j n"]:
    """Return n random postures (j, n) [rad or m] of all j movable joints of a URDF, in its order.
    Independent joints are uniform within their limits, and coupled joints follow them.

    `coupling` tells by name which joints follow others, and how. `seed` is the random seed. Raises
    `BadArgument` if `coupling` names a joint that the URDF lacks.
    """
    movable = {j.name: j for j in urdf.movable}
    named = {*coupling} | {name for mimic in coupling.values() for name, _ in mimic.terms}
    unknown = sorted(named - set(movable))
    if unknown:
        raise BadArgument("coupling", unknown[0], f"joints of the URDF: {sorted(movable)}")
    share = np.random.default_rng(seed).random((len(movable), n))
    drawn = {
        name: j.lower + (j.upper - j.lower) * share[k]
        for k, (name, j) in enumerate(movable.items())
    }
    for joint, mimic in coupling.items():
        drawn[joint] = mimic.follow(drawn)
    return torch.from_numpy(np.stack([drawn[name] for name in movable]))
