"""Postures of the hand's own that fit contacts: the nearest of many random ones, placed, and clear of all around.

The learned model (`query_mixture`) answers with the few postures that are likely for a code, wherever the object and the
table are. Here a few thousand random postures are compared with every triple in all six assignments, which one matrix
product does, and the nearest are ranked by their clearances, too: a hand from above comes before one from below.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import Value, join
from torchgrasp.errors import BadArgument
from torchgrasp.frames import apply, degenerate, inverse, rotate, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, collision_cost
from torchgrasp.ik.query import COSINE_SLACK, LENGTH_SLACK
from torchgrasp.ik.refine import TIP_WEIGHT
from torchgrasp.posture_model.encoding import PERMUTATIONS
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.values import Contacts, IKSeeds

POSTURES = 5000
"""Random postures that are compared; with 2000 or 20000 of them the share of triples with a grasp is 0.02 apart."""
CANDIDATES = 64
"""Nearest postures of a triple, in all assignments together, whose clearances are measured."""
CHUNK = 64
"""Triples that are compared at a time: memory is bounded, and the work stays in the cache."""


@dataclasses.dataclass(frozen=True)
class PostureLibrary(Value):
    """Postures with their tips' `centres` in their virtual frame [m], the `feature`, and the hand's spheres [m]."""

    hand: Hand
    joints: Float[Tensor, "s h"]
    vf_from_hand: Float[Tensor, "s 4 4"]
    centres: Float[Tensor, "s 3 3"]
    feature: Float[Tensor, "s 18"]
    spheres: Float[Tensor, "s k 3"]

    @classmethod
    def of(cls, hand: Hand, count: int = POSTURES, seed: int = 0) -> "PostureLibrary":
        """Draw postures within the limits and free of self-collision."""
        joints = sample_configurations(hand, count, seed).joints.to(hand.lower.device, torch.float64)
        joints = joints[~degenerate(hand.tip_centres(joints))]
        centres, (_, pads) = hand.tip_centres(joints), hand.fingertips(joints)
        vf_from_hand = inverse(virtual_frame(centres))
        centres, pads = apply(vf_from_hand, centres), rotate(vf_from_hand, pads)
        return cls(hand, joints, vf_from_hand, centres, feature(centres, pads), hand.sphere_centres(joints).float())


def feature(centres: Float[Tensor, "*b 3 3"], pads: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 18"]:
    """Return tips' centres and pads' axes in the units of the slacks that rolling makes up for."""
    return torch.cat([centres / LENGTH_SLACK, pads / COSINE_SLACK], -1).flatten(-2).float()


def nearest_postures(contacts: Contacts, postures: PostureLibrary, world: CollisionWorld, n_seeds: int = 8) -> IKSeeds:
    """Return the postures that fit contacts best, placed by Eq. (24) with the centres of round tips for fingertips.

    Args:
        contacts: contact triples on the object.
        postures: of the hand.
        surroundings: what the links must stay clear of.
        guesses: postures for each triple.

    Returns:
        The guesses in the order of the contacts' rows, best first within a row. `energy` is half the squared distance
        of the features. A degenerate row has no guesses.

    Raises:
        BadArgument: `n_seeds` is not in [1, 64].
    """
    if not 1 <= n_seeds <= CANDIDATES:
        raise BadArgument("n_seeds", n_seeds, f"1 to {CANDIDATES}")
    radius, order = postures.hand.tip_radius.double(), torch.tensor(PERMUTATIONS, device=contacts.points.device)
    inward = -contacts.normals.double()[:, order]
    centres = contacts.points.double()[:, order] - radius[:, None] * inward  # (n, 6, 3, 3)
    rows = torch.nonzero(~degenerate(centres).any(1))[:, 0]
    found = join([_nearest(centres[at], inward[at], at, postures, world, n_seeds) for at in rows.split(CHUNK)])
    return found.to(contacts.points.dtype)


def _nearest(
    centres: Float[Tensor, "b 6 3 3"],
    inward: Float[Tensor, "b 6 3 3"],
    row: Int[Tensor, "b"],
    postures: PostureLibrary,
    world: CollisionWorld,
    n_seeds: int,
) -> IKSeeds:
    """Return the guesses of a chunk of triples, each in the six orders of their contacts."""
    obj_from_vf = virtual_frame(centres)
    vf_from_obj = inverse(obj_from_vf)
    wanted, have = feature(apply(vf_from_obj, centres), rotate(vf_from_obj, inward)), postures.feature
    half = wanted.square().sum(-1)[..., None] / 2 + have.square().sum(-1) / 2 - wanted @ have.T
    reach, index = half.flatten(1).topk(CANDIDATES, 1, largest=False)
    order, sample = index // len(have), index % len(have)
    b = torch.arange(len(row), device=row.device)[:, None]
    obj_from_hand = obj_from_vf[b, order] @ postures.vf_from_hand[sample]
    spheres = apply(obj_from_hand.float(), postures.spheres[sample])
    tips = 2 * reach * (TIP_WEIGHT * LENGTH_SLACK / MILLIMETRE) ** 2  # squared millimetres, as `refine` weighs them
    crowd = collision_cost(spheres, postures.hand.collision_spheres, world)
    best = (tips + crowd).topk(n_seeds, 1, largest=False).indices.flatten()

    # From here on one row a guess.
    b = b.repeat_interleave(n_seeds)
    order, sample = order[b, best], sample[b, best]
    gap = apply(obj_from_vf[b, order], postures.centres[sample]) - centres[b, order]
    return IKSeeds(
        joints=postures.joints[sample],
        obj_from_hand=obj_from_hand[b, best],
        row=row[b],
        permutation=torch.tensor(PERMUTATIONS, device=row.device)[order],
        energy=reach[b, best].double(),
        tip_error=torch.linalg.vector_norm(gap, dim=-1),
    )
