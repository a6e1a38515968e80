"""Random postures of a hand, the nearest of which become seeds.

One matrix product compares the contacts of every row with thousands of postures, in all assignments or the likely ones.
Clearances rank the nearest, so a hand from above comes before one from below.
"""

import dataclasses
import hashlib
import itertools
from collections import OrderedDict

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.base import Value, check_device, check_whole, join, named_tensors
from torchgrasp.checks import Count, Seed, checked
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, degenerate, inverse, rigid, rotate, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.candidates import Reachable, ask_reachable
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, collision_cost
from torchgrasp.ik.refine import TIP_WEIGHT
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.values import Contacts, IKSeeds

LIBRARY_SIZE = 5000
"""Random postures of a library; with 2000 or 20000 the share of triples with a grasp differs by 0.02."""
LARGE_LIBRARY = 20_000
"""The same for more fingertips, fewer of whose contacts are near a posture: a fifth more grasps than with 5000, in a
second."""
LENGTH_SCALE, COSINE_SCALE = 0.01, 0.5
"""Distances of tip centres [m] and of pad axes that count the same: tips roll, and a solver turns them."""
CANDIDATES = 64
"""Nearest postures of a row, over all assignments, whose clearances are measured; also the most seeds of it."""
ASSIGNMENTS, JUDGES = 6, 500
"""Assignments of contacts to fingers in which a row is compared with the whole library: all of three fingertips. Of the
24 or 120 of more, those to which one of so many postures is nearest."""
KEPT = 4
"""Libraries kept in a process, 9 MB each, 40 MB for more fingertips: two hands with two sets of fingers."""
ASKED = 3
"""Seeds whose poses an arm is asked for, to each that is kept: an arm refuses about half."""


@checked
@dataclasses.dataclass(frozen=True)
class PostureLibrary(Value):
    """Postures of a hand, with tip `centres` [m] in the frames of `tips_frame`, `feature`s and collision `spheres`.

    >>> from torchgrasp import load_hand
    >>> library = PostureLibrary.of(load_hand("barrett"), count=200)
    >>> library.joints.shape, library.centres.shape
    (torch.Size([200, 4]), torch.Size([200, 3, 3]))
    """

    hand: Hand
    joints: Float[Tensor, "s h"]
    vf_from_hand: Float[Tensor, "s 4 4"]
    centres: Float[Tensor, "s f 3"]
    feature: Float[Tensor, "s d"]
    spheres: Float[Tensor, "s k 3"]

    def __post_init__(self) -> None:
        """Refuse postures of another hand."""
        f, spheres = len(self.hand.tips), len(self.hand.collision_spheres.radius)
        wanted = (self.hand.dof, f, 6 * f, spheres)
        found = tuple(x.shape[1] for x in (self.joints, self.centres, self.feature, self.spheres))
        if found != wanted:
            raise BadArgument("library", f"joints, tips, features and spheres {found}", f"those of the hand, {wanted}")

    @classmethod
    @checked
    def of(cls, hand: Hand, count: Count | None = None, seed: Seed = 0) -> "PostureLibrary":
        """Draw postures within the joint limits and free of self-collision; count None: as many as work well.

        The last libraries are kept: a process draws that of a hand once.
        """
        count = (LIBRARY_SIZE if len(hand.tips) == 3 else LARGE_LIBRARY) if count is None else count
        key = f"{_digest(hand)} {hand.lower.device} {count} {seed}"
        if key in _KEPT:
            _KEPT.move_to_end(key)
            return _KEPT[key]
        _KEPT[key] = library = cls._drawn(hand, count, seed)
        if len(_KEPT) > KEPT:
            _KEPT.popitem(last=False)
        return library

    @classmethod
    def _drawn(cls, hand: Hand, count: int, seed: int) -> "PostureLibrary":
        """Draw postures; see `of`."""
        joints = sample_configurations(hand, count, seed).joints.to(hand.lower.device, torch.float64)
        joints = joints[~degenerate(triangle_of(hand.tip_centres(joints)))]
        centres, (_, pads) = hand.tip_centres(joints), hand.fingertips(joints)
        vf_from_hand = inverse(tips_frame(centres))
        centres, pads = apply(vf_from_hand, centres), rotate(vf_from_hand, pads)
        return cls(hand, joints, vf_from_hand, centres, feature(centres, pads), hand.sphere_centres(joints).float())


_KEPT: "OrderedDict[str, PostureLibrary]" = OrderedDict()


def _digest(hand: Hand) -> str:
    """Return a hash of every number of a hand, whatever file it is from."""
    numbers = (t.detach().cpu().contiguous().numpy().tobytes() for t in named_tensors(hand).values())
    return hashlib.sha256(b"|".join([hand.name.encode(), *numbers])).hexdigest()


def triangle_of(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return the triangle that stands for points in the order of the fingers: first, centre of those between, last."""
    if points.shape[-2] == 3:
        return points
    between = points[..., 1:-1, :].mean(-2, keepdim=True)
    return torch.cat([points[..., :1, :], between, points[..., -1:, :]], -2)


def tips_frame(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b 4 4"]:
    """Return the `virtual_frame` of three to five points: that of their triangle, about the centre of all.

    Raises:
        DegenerateContacts: a triangle is too flat.
    """
    return rigid(virtual_frame(triangle_of(points))[..., :3, :3], points.mean(-2))


def feature(centres: Float[Tensor, "*b f 3"], pads: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b d"]:
    """Return tip centres and pad axes in units of their scales."""
    return torch.cat([centres / LENGTH_SCALE, pads / COSINE_SCALE], -1).flatten(-2).float()


@checked
def nearest_postures(
    library: PostureLibrary,
    contacts: Contacts,
    world: CollisionWorld,
    n_seeds: Count = 8,
    reachable: Reachable | None = None,
) -> IKSeeds:
    """Return the postures nearest to contacts, placed by Eq. (24) with the tips' centres for fingertips.

    Seeds come in the order of the contacts' rows, best first within a row. A row without a `tips_frame` has none.
    `energy` is half the squared distance of the features. Poses that `reachable` refuses make room for the next best
    ones.

    Raises:
        BadArgument: `n_seeds`, for each row, is not in [1, 64], or above six times the number of postures; contacts on
            another device than the library, or of another number than its fingertips.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp, library = load_shipped_grasp("jug", "barrett"), PostureLibrary.of(load_hand("barrett"), 1000)
    >>> seeds = nearest_postures(library, grasp.contacts, CollisionWorld(), n_seeds=4)
    >>> seeds.row, bool(seeds.tip_error.max() < 0.05)  # [m], before any refinement
    (tensor([0, 0, 0, 0]), True)
    """
    given, f, device = library.feature, len(library.hand.tips), contacts.points.device
    if contacts.fingertips != f:
        raise BadArgument("contacts", f"{contacts.fingertips} in a row", f"{f}, one for each fingertip of the hand")
    permutations = torch.tensor(list(itertools.permutations(range(f))), device=device)
    candidates = min(CANDIDATES, min(ASSIGNMENTS, len(permutations)) * len(given))
    check_whole("n_seeds", n_seeds, 1, candidates)
    check_device("contacts", device, "the library", given.device)
    radius, inward = library.hand.tips.radius.double(), -contacts.normals.double()[:, permutations]
    centres = contacts.points.double()[:, permutations] - radius[:, None] * inward  # (n, p, f, 3)
    framed = ~degenerate(triangle_of(centres))
    parts = []
    for row in torch.nonzero(framed.any(1))[:, 0].split(64):  # bounds the memory
        obj_from_vf, wanted = _describe(centres[row], inward[row], framed[row])
        assignment = _likely_assignments(wanted, given, framed[row])
        at = torch.arange(len(row), device=device)[:, None]
        obj_from_vf, wanted = obj_from_vf[at, assignment], wanted[at, assignment]
        energy = _energies(wanted, given, framed[row[:, None], assignment])
        energy, index = energy.flatten(1).topk(candidates, 1, largest=False)
        order, sample = index // len(given), index % len(given)
        obj_from_hand = obj_from_vf[at, order] @ library.vf_from_hand[sample]
        spheres = apply(obj_from_hand.float(), library.spheres[sample])
        tips = 2 * energy * (TIP_WEIGHT * LENGTH_SCALE / MILLIMETRE) ** 2  # squared millimetres, weighed as in `refine`
        cost = tips + collision_cost(spheres, library.hand.collision_spheres, world)
        if reachable is None:
            best = cost.topk(n_seeds, 1, largest=False).indices.flatten()
            b = at.repeat_interleave(n_seeds)  # from here on one row a seed
        else:
            best = cost.topk(min(ASKED * n_seeds, candidates), 1, largest=False).indices
            reached = ask_reachable(reachable, obj_from_hand[at, best].flatten(0, 1)).reshape(best.shape)
            kept = reached & (reached.cumsum(1) <= n_seeds)
            b, best = at.expand_as(best)[kept], best[kept]
        order, sample = order[b, best], sample[b, best]
        chosen = assignment[b, order]
        gap = apply(obj_from_vf[b, order], library.centres[sample]) - centres[row[b], chosen]
        tip_error, energy = torch.linalg.vector_norm(gap, dim=-1), energy[b, best].double()
        joints, pose = library.joints[sample], obj_from_hand[b, best]
        parts.append(IKSeeds(joints, pose, row[b], permutations[chosen], energy, tip_error))
    return join(parts).to(contacts.points.dtype)


def _describe(
    centres: Float[Tensor, "r p f 3"], inward: Float[Tensor, "r p f 3"], framed: Bool[Tensor, "r p"]
) -> tuple[Float[Tensor, "r p 4 4"], Float[Tensor, "r p d"]]:
    """Return frames and features of contacts in every assignment, any where an assignment is not `framed`."""
    stand_in = torch.eye(3, dtype=centres.dtype, device=centres.device)
    triangle = torch.where(framed[..., None, None], triangle_of(centres), stand_in)
    obj_from_vf = rigid(virtual_frame(triangle)[..., :3, :3], centres.mean(-2))
    vf_from_obj = inverse(obj_from_vf)
    return obj_from_vf, feature(apply(vf_from_obj, centres), rotate(vf_from_obj, inward))


def _energies(
    wanted: Float[Tensor, "r p d"], given: Float[Tensor, "s d"], framed: Bool[Tensor, "r p"]
) -> Float[Tensor, "r p s"]:
    """Return half the squared distance of features from those of the postures, infinite without a frame."""
    energy = wanted.square().sum(-1)[..., None] / 2 + given.square().sum(-1) / 2 - wanted @ given.T
    return torch.where(framed[..., None], energy, torch.inf)


def _likely_assignments(
    wanted: Float[Tensor, "r p d"], given: Float[Tensor, "s d"], framed: Bool[Tensor, "r p"]
) -> Int[Tensor, "r a"]:
    """Return the `ASSIGNMENTS` of each row to which one of the first `JUDGES` postures is nearest."""
    if wanted.shape[1] <= ASSIGNMENTS:
        return torch.arange(wanted.shape[1], device=wanted.device).expand(len(wanted), -1)
    nearest = _energies(wanted, given[:JUDGES], framed).amin(-1)
    return nearest.topk(ASSIGNMENTS, 1, largest=False).indices
