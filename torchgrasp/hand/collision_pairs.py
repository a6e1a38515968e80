"""The collision shapes of a URDF, and the pairs of links that can meet: random postures tell them, hand.toml has them.

A cylinder becomes a prism of twelve sides, 2 % off.
"""

import itertools
import math
from collections.abc import Iterable, Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_whole
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import rotation_from_rpy
from torchgrasp.hand.kinematics import tree_from_urdf
from torchgrasp.hand.self_collision import SelfCollision
from torchgrasp.hand.urdf import Mimic, Shape, Triple, Urdf

PRISM_BOXES = 6
"""Boxes whose union is the prism of a cylinder: each reaches from one side to the opposite one."""
MOST_PAIRS = 20_000
"""Most pairs of shapes to test; all of the Shadow hand's, which has most of the shipped ones, are 7427."""
MEETING_DISTANCE = 0.002
"""Links that come nearer than this [m] in some posture are a pair to test."""
ALWAYS = 0.98
"""Links that overlap in a larger share of the postures overlap by construction, and are no pair to test."""
FIRST_LOOK = 1000
"""Postures after which links that overlap in each are left alone: of those in `ALWAYS`, one in 10^9 does."""
MOST_FIRST, MOST_TESTS = 2_000_000, 20_000_000
"""Most separations of near shapes [each 0.6 us] to measure in the first look, and after a look in all that follow.

Shadow has 0.5 million in the first look, and 2 million in all.
"""
ROWS_PER_CHUNK, NUMBERS_PER_CHUNK = 1000, 100_000
"""Most postures tested at a time, and most separations: 200 MB where all are of boxes that are near."""


def collision_pairs(urdf: Urdf, coupling: Mapping[str, Mimic], n: int = 20_000, seed: int = 0) -> list[tuple[str, str]]:
    """Return the pairs of links that meet in some of n random postures, but not in nearly all, without neighbours.

    Every joint is uniform within its limits, so that the pairs serve all finger options. An n outside [1, 10^7], or a
    coupling with joints that the URDF lacks, raises `BadArgument`.

    >>> from torchgrasp.hand.load import find_hand
    >>> from torchgrasp.hand.urdf import read_urdf
    >>> collision_pairs(read_urdf(find_hand("allegro") / "hand.urdf"), {}, n=100)[0]
    ('palm', 'thumb_medial')
    """
    check_whole("n", n, 1, 10**7)
    tree, shapes = tree_from_urdf(urdf), self_collision_from_urdf(urdf, None)
    if not len(shapes.pairs):
        return []
    links, owner = torch.unique(shapes.link[shapes.pairs].sort(1).values, dim=0, return_inverse=True)
    met, near = torch.zeros(2, len(links))
    done = 0
    for look in draw_postures(urdf, coupling, n, seed).split(FIRST_LOOK, 1):
        if not len(owner):
            break
        rows = max(1, min(ROWS_PER_CHUNK, NUMBERS_PER_CHUNK // len(owner)))
        first, *others = look.split(rows, 1)
        frames = tree.frames(first)
        if not done:
            _limit_near(urdf, shapes, frames, look.shape[1], MOST_FIRST)
        for posed in itertools.chain([frames], map(tree.frames, others)):
            apart = shapes.separations(posed, MEETING_DISTANCE)
            least = apart.new_full((len(links), apart.shape[1]), torch.inf)
            least.scatter_reduce_(0, owner[:, None].expand_as(apart), apart, "amin")
            met += (least < 0).sum(1)
            near += (least < MEETING_DISTANCE).sum(1)
        done += look.shape[1]
        met[met >= done] = torch.inf
        settled = (met == torch.inf) | ((near > 0) & (met + (n - done) <= ALWAYS * n))  # whatever the rest says
        kept = ~settled[owner]
        shapes, owner = shapes.only(kept), owner[kept]
        _limit_near(urdf, shapes, frames, n - done, MOST_TESTS)
    meeting = links[(near > 0) & (met <= ALWAYS * n)]
    return [(tree.link_names[i], tree.link_names[j]) for i, j in meeting.tolist()]


def _limit_near(urdf: Urdf, shapes: SelfCollision, frames: Float[Tensor, "3 4 l n"], ahead: int, most: int) -> None:
    """Refuse shapes that, if the postures ahead are like those of `frames`, have too many separations to measure."""
    left = shapes.count_near(frames, MEETING_DISTANCE) * ahead // frames.shape[3]
    if left > most:
        found = f"shapes of {len(shapes.pairs)} pairs so near each other that {left} separations are to be measured"
        raise urdf.wrong(found, f"at most {most}: fewer shapes in one place")


def draw_postures(urdf: Urdf, coupling: Mapping[str, Mimic], n: int, seed: int) -> Float[Tensor, "j n"]:
    """Draw every movable joint uniformly within its limits; coupled joints follow."""
    movable = {j.name: j for j in urdf.movable}
    unknown = sorted(({*coupling} | {mimic.source for mimic in coupling.values()}) - set(movable))
    if unknown:
        raise BadArgument("coupling", unknown[0], f"joints of the URDF: {sorted(movable)}")
    share = np.random.default_rng(seed).random((len(movable), n))
    drawn = {name: j.lower + (j.upper - j.lower) * share[k] for k, (name, j) in enumerate(movable.items())}
    for joint, mimic in coupling.items():
        drawn[joint] = mimic.ratio * drawn[mimic.source] + mimic.offset
    return torch.from_numpy(np.stack([drawn[name] for name in movable]))


def self_collision_from_urdf(urdf: Urdf, pairs: Iterable[tuple[str, str]] | None) -> SelfCollision:
    """Return the shapes of a URDF with the `pairs` of links to test; None: all but neighbours; `MOST_PAIRS` at most."""
    names = [x.name for x in urdf.links]
    tested = {frozenset(pair) for pair in (itertools.combinations(names, 2) if pairs is None else pairs)}
    if pairs is None:
        tested -= {frozenset((j.parent, j.child)) for j in urdf.joints}
    shapes = [(i, *part) for i, link in enumerate(urdf.links) for shape in link.shapes for part in _parts(shape)]
    link, rotation, center, half, radius = zip(*shapes, strict=True)
    places = {i: list(of) for i, of in itertools.groupby(range(len(shapes)), link.__getitem__)}
    meeting = [(i, j) for i in places for j in places if j >= i and frozenset((names[i], names[j])) in tested]
    if (many := sum(len(places[i]) * len(places[j]) for i, j in meeting)) > MOST_PAIRS:
        raise urdf.wrong(f"{many} pairs of shapes to test for collisions", f"at most {MOST_PAIRS}, a cylinder as six")
    kinds: tuple[list[tuple[int, int]], ...] = ([], [], [])
    for one, two in sorted((one, two) for i, j in meeting for one in places[i] for two in places[j] if two > one):
        spheres = radius[one] > 0, radius[two] > 0
        kinds[sum(spheres)].append((two, one) if spheres == (False, True) else (one, two))
    return SelfCollision(
        link=torch.tensor(link),
        rotation=torch.stack(rotation, -1),
        center=torch.tensor(center, dtype=torch.float64),
        half=torch.tensor(half, dtype=torch.float64),
        radius=torch.tensor(radius, dtype=torch.float64),
        pairs=torch.tensor([pair for kind in kinds for pair in kind], dtype=torch.long).reshape(-1, 2),
        kinds=(len(kinds[0]), len(kinds[1]), len(kinds[2])),
    )


def _parts(shape: Shape) -> list[tuple[Float[Tensor, "3 3"], Triple, Triple, float]]:
    """Return the boxes or the sphere of a shape: rotation, centre, half sizes, radius."""
    rotation = rotation_from_rpy(shape.rpy)
    if shape.kind == "sphere":
        return [(rotation, shape.xyz, (0.0, 0.0, 0.0), shape.size[0])]
    if shape.kind == "box":
        x, y, z = shape.size
        return [(rotation, shape.xyz, (x / 2, y / 2, z / 2), 0.0)]
    step = math.pi / PRISM_BOXES
    corner = 2 * shape.size[0] / (1 + math.cos(step / 2))  # as far outside the circle as the sides are inside
    half = (corner * math.cos(step / 2), corner * math.sin(step / 2), shape.size[1] / 2)
    return [(rotation @ rotation_from_rpy((0.0, 0.0, k * step)), shape.xyz, half, 0.0) for k in range(PRISM_BOXES)]
