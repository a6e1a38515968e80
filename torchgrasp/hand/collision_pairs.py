"""The pairs of links that can meet, learned from random postures. hand.toml stores them."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import check_whole
from torchgrasp.errors import BadArgument
from torchgrasp.hand.kinematics import tree_from_urdf
from torchgrasp.hand.self_collision import self_collision_from_urdf
from torchgrasp.hand.urdf import Mimic, Urdf

MEETING_DISTANCE = 0.002
"""Links that come nearer than this [m] in some posture are a pair to test."""
ALWAYS = 0.98
"""Links that overlap in a larger share of the postures overlap by construction, and are no pair to test."""
FIRST_LOOK = 1000
"""Postures after which links that overlap in each are left alone: of those in `ALWAYS`, one in 10^9 does."""
ROWS_PER_CHUNK, NUMBERS_PER_CHUNK = 1000, 500_000
"""Most postures tested at a time, and most separations: 400 MB where all are of boxes that are near."""


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
    rows, done = max(1, min(ROWS_PER_CHUNK, NUMBERS_PER_CHUNK // len(shapes.pairs))), 0
    first, rest = draw_postures(urdf, coupling, n, seed).tensor_split([FIRST_LOOK], 1)
    for values in (*first.split(rows, 1), *rest.split(rows, 1)):
        if done == FIRST_LOOK:
            kept = (met < done)[owner]
            kinds = [int(kind.sum()) for kind in kept.split(shapes.kinds)]
            shapes = dataclasses.replace(shapes, pairs=shapes.pairs[kept], kinds=(kinds[0], kinds[1], kinds[2]))
            met, owner = torch.where(met < done, met, torch.inf), owner[kept]
        apart = shapes.separations(tree.frames(values), MEETING_DISTANCE)
        least = apart.new_full((len(links), apart.shape[1]), torch.inf)
        least.scatter_reduce_(0, owner[:, None].expand_as(apart), apart, "amin")
        met += (least < 0).sum(1)
        near += (least < MEETING_DISTANCE).sum(1)
        done += values.shape[1]
    meeting = links[(near > 0) & (met <= ALWAYS * n)]
    return [(tree.link_names[i], tree.link_names[j]) for i, j in meeting.tolist()]


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
