"""Random postures of a hand, the nearest of which become seeds.

One matrix product compares every triple with thousands of postures in all assignments. Clearances rank the nearest, so
a hand from above comes before one from below.
"""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.base import Value, check_device, check_whole, join
from torchgrasp.frames import apply, degenerate, inverse, rotate, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.candidates import Reachable, ask_reachable
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, collision_cost
from torchgrasp.ik.refine import TIP_WEIGHT
from torchgrasp.posture_model.encoding import PERMUTATIONS
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.values import Contacts, IKSeeds

LIBRARY_SIZE = 5000
"""Random postures of a library; with 2000 or 20000 the share of triples with a grasp differs by 0.02."""
LENGTH_SCALE, COSINE_SCALE = 0.01, 0.5
"""Distances of tip centres [m] and of pad axes that count the same: tips roll, and a solver turns them."""
CANDIDATES = 64
"""Nearest postures of a triple, over all assignments, whose clearances are measured; also the most seeds of it."""
ASKED = 3
"""Seeds whose poses an arm is asked for, to each that is kept: an arm refuses about half."""


@dataclasses.dataclass(frozen=True)
class PostureLibrary(Value):
    """Postures of a hand, with tip `centres` [m] in virtual frames, `feature`s and collision `spheres` [m]."""

    hand: Hand
    joints: Float[Tensor, "s h"]
    vf_from_hand: Float[Tensor, "s 4 4"]
    centres: Float[Tensor, "s 3 3"]
    feature: Float[Tensor, "s 18"]
    spheres: Float[Tensor, "s k 3"]

    @classmethod
    def of(cls, hand: Hand, count: int = LIBRARY_SIZE, seed: int = 0) -> "PostureLibrary":
        """Draw postures within the joint limits and free of self-collision."""
        joints = sample_configurations(hand, count, seed).joints.to(hand.lower.device, torch.float64)
        joints = joints[~degenerate(hand.tip_centres(joints))]
        centres, (_, pads) = hand.tip_centres(joints), hand.fingertips(joints)
        vf_from_hand = inverse(virtual_frame(centres))
        centres, pads = apply(vf_from_hand, centres), rotate(vf_from_hand, pads)
        return cls(hand, joints, vf_from_hand, centres, feature(centres, pads), hand.sphere_centres(joints).float())


def feature(centres: Float[Tensor, "*b 3 3"], pads: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 18"]:
    """Return tip centres and pad axes in units of their scales."""
    return torch.cat([centres / LENGTH_SCALE, pads / COSINE_SCALE], -1).flatten(-2).float()


def nearest_postures(
    library: PostureLibrary,
    contacts: Contacts,
    world: CollisionWorld,
    n_seeds: int = 8,
    reachable: Reachable | None = None,
) -> IKSeeds:
    """Return the postures nearest to contacts, placed by Eq. (24) with the tips' centres for fingertips.

    Seeds come in the order of the contacts' rows, best first within a row. A degenerate row has none. `energy` is half
    the squared distance of the features. Poses that `reachable` refuses make room for the next best ones.

    Raises:
        BadArgument: `n_seeds`, for each triple, is not in [1, 64], or above six times the number of postures;
            contacts on another device than the library.
    """
    permutations, given = torch.tensor(PERMUTATIONS, device=contacts.points.device), library.feature
    candidates = min(CANDIDATES, len(permutations) * len(given))
    check_whole("n_seeds", n_seeds, 1, candidates)
    check_device("contacts", contacts.points.device, "the library", given.device)
    radius, inward = library.hand.tips.radius.double(), -contacts.normals.double()[:, permutations]
    centres = contacts.points.double()[:, permutations] - radius[:, None] * inward  # (n, 6, 3, 3)
    parts = []
    for row in torch.nonzero(~degenerate(centres).any(1))[:, 0].split(64):  # bounds the memory
        obj_from_vf = virtual_frame(centres[row])
        vf_from_obj = inverse(obj_from_vf)
        wanted = feature(apply(vf_from_obj, centres[row]), rotate(vf_from_obj, inward[row]))
        energy = wanted.square().sum(-1)[..., None] / 2 + given.square().sum(-1) / 2 - wanted @ given.T
        energy, index = energy.flatten(1).topk(candidates, 1, largest=False)
        order, sample = index // len(given), index % len(given)
        b = torch.arange(len(row), device=row.device)[:, None]
        obj_from_hand = obj_from_vf[b, order] @ library.vf_from_hand[sample]
        spheres = apply(obj_from_hand.float(), library.spheres[sample])
        tips = 2 * energy * (TIP_WEIGHT * LENGTH_SCALE / MILLIMETRE) ** 2  # squared millimetres, weighed as in `refine`
        cost = tips + collision_cost(spheres, library.hand.collision_spheres, world)
        if reachable is None:
            best = cost.topk(n_seeds, 1, largest=False).indices.flatten()
            b = b.repeat_interleave(n_seeds)  # from here on one row a seed
        else:
            best = cost.topk(min(ASKED * n_seeds, candidates), 1, largest=False).indices
            reached = ask_reachable(reachable, obj_from_hand[b, best].flatten(0, 1)).reshape(best.shape)
            kept = reached & (reached.cumsum(1) <= n_seeds)
            b, best = b.expand_as(best)[kept], best[kept]
        order, sample = order[b, best], sample[b, best]
        gap = apply(obj_from_vf[b, order], library.centres[sample]) - centres[row[b], order]
        tip_error, energy = torch.linalg.vector_norm(gap, dim=-1), energy[b, best].double()
        joints, pose = library.joints[sample], obj_from_hand[b, best]
        parts.append(IKSeeds(joints, pose, row[b], permutations[order], energy, tip_error))
    return join(parts).to(contacts.points.dtype)
