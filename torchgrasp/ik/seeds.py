"""Initial guesses (seeds) of hand pose and joints near contacts, from random postures or the
learned model.

One matrix product compares all contact sets with thousands of postures. Clearances rank the nearest
postures. Here r counts contact sets, p assignments of contacts to fingers, s postures, and f
fingertips. There are d = 6 f numbers of a feature vector.
"""

import dataclasses
import itertools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import (
    Value,
    at_once,
    check_device,
    check_whole,
    flatnonzero,
    join,
    lexical_order,
    row_numbers,
    settle,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Count, Positive, Seed
from torchgrasp.geometry.frames import apply, degenerate, inverse, rigid, rotate, virtual_frame
from torchgrasp.geometry.linalg import check_unit_vectors, dot, eye_like, norm
from torchgrasp.hand.hand import Hand
from torchgrasp.ik.candidates import Reachable, ask_reachable
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, collision_cost, is_world_fused
from torchgrasp.ik.refine import TIP_WEIGHT
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, GraspMixture, check_mixture, encode
from torchgrasp.posture_model.sample import sample_configurations
from torchgrasp.values.planning import Contacts, IKSeeds


@dataclasses.dataclass(frozen=True)
class SeedNumbers:
    """Parameters of the search for initial guesses (seeds) of hand poses and joints.

    They come from a library of random postures, or from the learned model.
    """

    length_scale: float = 0.01
    """Difference of tip centres [m] that counts as much as `cosine_scale`."""
    cosine_scale: float = 0.5
    """Difference of unit pad axes that counts as much as `length_scale`."""
    postures: int = 5000
    """Number of random postures in the library of a hand with three fingers."""
    many_postures: int = 20_000
    """Number of random postures in the library of a hand with more fingers, whose contact sets have
    more shapes.
    """
    candidates: int = 64
    """Number of nearest postures of a contact set that are checked for clearance."""
    assignments: int = 6
    """Number of assignments of contacts to fingers that are compared with the whole library."""
    compared: int = 500
    """Number of postures of the library by which these assignments are chosen."""
    spare: int = 3
    """Ratio of the number of postures that are checked for reachability to that of the wanted
    initial guesses.
    """
    wrong_side: float = 0.3
    """Mean cosine of the normals of tips and contacts above which an initial guess touches from
    inside.
    """
    rows: int = 64
    """Number of contact sets that are compared with the library at a time, to bound the memory."""
    queried: int = 256
    """Number of contact sets that are given to the model at a time: they stay in the cache."""


SEEDS = SeedNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class PostureLibrary(Value):
    """Random postures of a hand, prepared for a quick comparison with contact sets.

    `PostureLibrary.of` makes it, and `nearest_postures` uses it. s counts postures, h actuated
    joints, f fingertips, and k collision spheres.

    The fingertips of each posture define a virtual frame, "vf", with the origin at their centroid.
    Its x axis points from the first to the last fingertip. Its z axis is normal to the plane
    through these two and the centroid of the others (Eqs. 15-17 of the paper).

    Attributes:
        hand: the hand.
        joints: actuated joints (s, h) [rad or m].
        vf_from_hand: pose (s, 4, 4) [m] of the hand's root link in the frame vf.
        centres: centres (s, f, 3) [m] of the fingertips, in the frame vf.
        feature: numbers (s, 6 f) without unit by which postures are compared. Each fingertip has
            six: its centre divided by 10 mm (`SEEDS.length_scale`), then the outward unit normal of
            its pad divided by 0.5 (`SEEDS.cosine_scale`). The pad is the part that touches objects.
            Both are in the frame vf.
        spheres: centres (s, k, 3) [m] of the collision spheres, in the frame of the hand's root
            link.

    Raises `BadArgument` for numbers of joints, tips or spheres that are not the hand's.

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
        """Check that the postures fit the hand."""
        f = len(self.hand.tips)
        spheres = len(self.hand.collision_spheres.radius)
        wanted = (self.hand.dof, f, 6 * f, spheres)
        found = tuple(x.shape[1] for x in (self.joints, self.centres, self.feature, self.spheres))
        if found != wanted:
            raise BadArgument(
                "library",
                f"joints, tips, features and spheres {found}",
                f"{wanted}, as the hand has",
            )

    @classmethod
    @checked
    def of(cls, hand: Hand, count: Count | None = None, seed: Seed = 0) -> "PostureLibrary":
        """Return random postures of a hand within the joint limits and without self-collision.

        Postures whose fingertips are on a line are left out, so there may be fewer than `count`.
        The result is cached in `hand.derived`.

        Args:
            hand: the hand.
            count: number of drawn postures. None means 5000 (`SEEDS.postures`), or 20,000
                (`SEEDS.many_postures`) for more than three fingers.
            seed: seed of the draws.

        Raises `BadArgument` for a hand of which almost no random posture is kept.
        """
        if count is None:
            count = SEEDS.postures if len(hand.tips) == 3 else SEEDS.many_postures
        found = hand.derived.get((PostureLibrary, count))
        if found is None or found[0] != seed:
            found = hand.derived[PostureLibrary, count] = seed, cls._drawn(hand, count, seed)
        return found[1]

    @classmethod
    def _drawn(cls, hand: Hand, count: int, seed: int) -> "PostureLibrary":
        """Return `count` random postures without those whose fingertips are on a line."""
        joints = sample_configurations(hand, count, seed).joints.to(
            hand.lower.device, torch.float64
        )
        joints = joints[~degenerate(triangle_of(hand.tip_centres(joints)))]
        centres = hand.tip_centres(joints)
        _, pads = hand.fingertips(joints)
        vf_from_hand = inverse(tips_frame(centres))
        centres = apply(vf_from_hand, centres)
        pads = rotate(vf_from_hand, pads)
        return cls(
            hand,
            joints,
            vf_from_hand,
            centres,
            feature(centres, pads),
            # the coordinates of a posture's spheres lie side by side by axis, as they are used
            hand.sphere_centres(joints).float().mT.contiguous().mT,
        )


def triangle_of(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b 3 3"]:
    """Return a triangle (*b, 3, 3) [m] for f = 3 to 5 points [m]: the first, the centroid of the
    middle ones, and the last.
    """
    if points.shape[-2] == 3:
        return points
    first, middle, last = points.split([1, points.shape[-2] - 2, 1], -2)
    return torch.cat([first, middle.mean(-2, keepdim=True), last], -2)


def tips_frame(points: Float[Tensor, "*b f 3"]) -> Float[Tensor, "*b 4 4"]:
    """Return the pose (*b, 4, 4) [m] of the virtual frame of 3 to 5 points [m].

    It is in the frame of the points. Its origin is the centroid of the points. The x axis points
    from the first to the last point. The z axis is normal to the plane through these two and the
    centroid of the others.
    """
    return rigid(virtual_frame(triangle_of(points))[..., :3, :3], points.mean(-2))


def feature(
    centres: Float[Tensor, "*b f 3"], pads: Float[Tensor, "*b f 3"]
) -> Float[Tensor, "*b d"]:
    """Return the feature vector (d = 6 f numbers without unit) of a posture with f fingertips.

    Each tip has its centre divided by 10 mm (`SEEDS.length_scale`), then the axis of its pad
    divided by 0.5 (`SEEDS.cosine_scale`). `centres` [m] and the unit vectors `pads` are in the
    virtual frame of the tips (`tips_frame`).
    """
    scaled = torch.cat([centres / SEEDS.length_scale, pads / SEEDS.cosine_scale], -1)
    return scaled.flatten(-2).float()


@checked
def nearest_postures(
    library: PostureLibrary,
    contacts: Contacts,
    world: CollisionWorld,
    n_seeds: Count = 8,
    reachable: Reachable | None = None,
) -> IKSeeds:
    """Return initial guesses for inverse kinematics: postures of a library, placed on contact sets
    (Eq. 24 of the paper).

    The guesses are in the order of the contact sets. Each set has at most `n_seeds`, best first,
    and none if its contacts lie on a line. A guess is better if its fingertips are nearer to the
    contacts, and its links clear of the `world`. Its `energy` is half the squared distance between
    the features of posture and contacts (`PostureLibrary.feature`).

    Args:
        library: random postures of the hand.
        contacts: b contact sets [m], with one contact for each fingertip.
        world: surroundings in the frame of the contacts.
        n_seeds: most guesses of a contact set, 1 to 64.
        reachable: function of hand poses (k, 4, 4) [m] in the frame of the contacts. It returns a
            mask (k,) of the poses that an arm reaches. The next posture takes the place of an
            unreachable one. At most 3 `n_seeds` postures (`SEEDS.spare`) of a contact set are
            tried. None means that every pose is reachable.

    Raises:
        BadArgument: `n_seeds` outside [1, 64], or above six times the number of postures in the
            library.
        BadArgument: contacts on another device than the library, or of another number than
            fingertips.
        BadArgument: normals that are not of length 1 (to 1e-3), if they are on the CPU.

    >>> from torchgrasp import load_hand
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> contacts = load_shipped_grasp("jug", "barrett").contacts
    >>> library = PostureLibrary.of(load_hand("barrett"), 1000)
    >>> seeds = nearest_postures(library, contacts, CollisionWorld(), n_seeds=4)
    >>> seeds.tip_error.max() < 0.05  # [m]
    tensor(True)
    """
    given = library.feature
    f = len(library.hand.tips)
    device = contacts.points.device
    if contacts.fingertips != f:
        raise BadArgument(
            "contacts",
            f"{contacts.fingertips} in a row",
            f"{f}, one for each fingertip of the hand",
        )
    # elsewhere a plan would wait for the device
    if device.type == "cpu":
        check_unit_vectors("contacts.normals", contacts.normals)
    permutations = torch.tensor(list(itertools.permutations(range(f))), device=device)
    assignments = min(SEEDS.assignments, len(permutations))
    candidates = min(SEEDS.candidates, assignments * len(given))
    check_whole("n_seeds", n_seeds, 1, candidates)
    check_device("contacts", device, "the library", given.device)
    radius = library.hand.tips.radius.double()
    inward = -contacts.normals.double()[:, permutations]
    centres = contacts.points.double()[:, permutations] - radius[:, None] * inward  # (n, p, f, 3)
    framed = ~degenerate(triangle_of(centres))
    count = n_seeds if reachable is None else min(SEEDS.spare * n_seeds, candidates)
    parts = []
    for row in flatnonzero(framed.any(1)).split(at_once(centres, SEEDS.rows)):
        # of all assignments of contacts to fingers, a few are compared with the whole library
        obj_from_vf, wanted = _describe(centres[row], inward[row], framed[row])
        assignment = _likely_assignments(wanted, given, framed[row])
        at = row_numbers(row)[:, None]
        obj_from_vf = obj_from_vf[at, assignment]
        wanted = wanted[at, assignment]
        energy = _energies(wanted, given, framed[row[:, None], assignment])
        # pairs of assignment and posture, best first (r, c)
        energy = energy.flatten(1)
        there = world.rows(row)
        pair = _rank_pairs(library, energy, obj_from_vf, there, candidates, count)
        order = pair // len(given)
        sample = pair % len(given)
        obj_from_hand = obj_from_vf[at, order] @ library.vf_from_hand[sample]
        b, best = _choose(obj_from_hand, n_seeds, reachable)
        energy = energy[b, pair[b, best]].double()
        order = order[b, best]
        sample = sample[b, best]
        chosen = assignment[b, order]
        gap = apply(obj_from_vf[b, order], library.centres[sample]) - centres[row[b], chosen]
        tip_error = norm(gap)
        joints = library.joints[sample]
        pose = obj_from_hand[b, best]
        parts.append(IKSeeds(joints, pose, row[b], permutations[chosen], energy, tip_error))
    return join(parts).to(contacts.points.dtype)


def _rank_pairs(
    library: PostureLibrary,
    energy: Float[Tensor, "r p"],
    obj_from_vf: Float[Tensor, "r a 4 4"],
    world: CollisionWorld,
    candidates: int,
    count: int,
) -> Int[Tensor, "r count"]:
    """Return the pairs of assignment and posture of the least cost [mm2], best first.

    Pair a s + k is that of assignment a and posture k. Only the `candidates` of the least `energy`
    are placed, by Eq. (24). The cost is that of the tips' error plus `collision_cost`.
    """
    # squared millimetres, weighed as in `refine`
    weight = 2 * (TIP_WEIGHT * SEEDS.length_scale / MILLIMETRE) ** 2
    posed = obj_from_vf, library.vf_from_hand, library.spheres
    spheres = library.hand.collision_spheres
    if is_world_fused(world, *posed[:2]):
        from torchgrasp.ik import fused_seeds  # it imports numba

        return fused_seeds.rank_pairs(energy, *posed, spheres, world, weight, candidates, count)
    energy, pair = energy.topk(candidates, 1, largest=False)
    sample = pair % len(library.joints)
    at = row_numbers(pair)[:, None]
    placed = obj_from_vf[at, pair // len(library.joints)] @ library.vf_from_hand[sample]
    placed = placed.flatten(0, 1).float()
    centres = library.spheres.mT[sample.flatten()]
    centres = torch.baddbmm(placed[:, :3, 3:], placed[:, :3, :3], centres)
    centres = centres.mT.unflatten(0, sample.shape)  # (r, c, k, 3)
    cost = weight * energy + collision_cost(centres, spheres, world)
    return pair.gather(1, cost.topk(count, 1, largest=False).indices)


def _choose(
    obj_from_hand: Float[Tensor, "r c 4 4"], n_seeds: int, reachable: Reachable | None
) -> tuple[Int[Tensor, "k"], Int[Tensor, "k"]]:
    """Return the contact set of each chosen candidate, then its index among the c candidates of the
    set, best first.

    At most `n_seeds` of each set are chosen, the first. The next takes the place of a hand pose
    that is not `reachable`.
    """
    reached = torch.zeros_like(obj_from_hand[..., 0, 0], dtype=torch.bool)
    at = row_numbers(obj_from_hand)[:, None].expand_as(reached)
    best = torch.arange(reached.shape[1], device=at.device).expand_as(reached)
    if reachable is None:
        return at.flatten(), best.flatten()
    # the spare ones are asked for only where some of the first are refused
    for some in (slice(n_seeds), slice(n_seeds, None)):
        short = flatnonzero(reached.sum(1) < n_seeds)
        poses = obj_from_hand[short, some]
        answers = ask_reachable(reachable, poses.flatten(0, 1))
        reached[short, some] = answers.reshape(poses.shape[:2])
    kept = reached & (reached.cumsum(1) <= n_seeds)
    return at[kept], best[kept]


def _describe(
    centres: Float[Tensor, "r p f 3"], inward: Float[Tensor, "r p f 3"], framed: Bool[Tensor, "r p"]
) -> tuple[Float[Tensor, "r p 4 4"], Float[Tensor, "r p d"]]:
    """Return frames [m], then features of r contact sets for p assignments to fingers, valid where
    `framed` is true.
    """
    stand_in = eye_like(3, centres)
    triangle = torch.where(framed[..., None, None], triangle_of(centres), stand_in)
    obj_from_vf = rigid(virtual_frame(triangle)[..., :3, :3], centres.mean(-2))
    vf_from_obj = inverse(obj_from_vf)
    return obj_from_vf, feature(apply(vf_from_obj, centres), rotate(vf_from_obj, inward))


def _energies(
    wanted: Float[Tensor, "r p d"], given: Float[Tensor, "s d"], framed: Bool[Tensor, "r p"]
) -> Float[Tensor, "r p s"]:
    """Return half the squared distance between the features of contacts and postures; infinite
    where not `framed`.
    """
    # one product, as each pass over so many numbers costs as much: w w / 2 + g g / 2 - w g
    half = torch.where(framed, wanted.square().sum(-1) / 2, torch.inf)
    one = torch.ones_like(half)
    rows = torch.cat([wanted, half[..., None], one[..., None]], -1)
    columns = torch.cat(
        [-given, torch.ones_like(given[:, :1]), given.square().sum(-1, True) / 2], 1
    )
    return rows @ columns.T


def _likely_assignments(
    wanted: Float[Tensor, "r p d"], given: Float[Tensor, "s d"], framed: Bool[Tensor, "r p"]
) -> Int[Tensor, "r a"]:
    """Return the indices of the a assignments of contacts to fingers with the nearest features.
    They are nearest to one of the first postures.
    """
    if wanted.shape[1] <= SEEDS.assignments:
        return torch.arange(wanted.shape[1], device=wanted.device).expand(len(wanted), -1)
    nearest = _energies(wanted, given[: SEEDS.compared], framed).amin(-1)
    return nearest.topk(SEEDS.assignments, 1, largest=False).indices


@checked
def query_mixture(
    hand: Hand,
    contacts: Contacts,
    mixture: GraspMixture,
    n_seeds: Count = 8,
    max_energy: Positive = DEFAULT_ENERGY,
) -> IKSeeds:
    """Return initial guesses (seeds) for sets of three contacts from the learned model `mixture`.

    They follow Eqs. (21)-(24) of the paper. An assignment of contacts to fingers is reachable if
    its energy is below `max_energy`. The energy (Eq. 21, no unit) is half the squared Mahalanobis
    distance of the contacts from the nearest Gaussian of the model. Each reachable assignment gives
    `n_seeds` seeds: the mean joints given the contacts (Eq. 23), and the mean joints of the
    Gaussians of the model that explain the contacts best. The seeds of a contact set are sorted.
    Seeds that touch the surface from outside come first, then the tip error counts. A contact set
    without a reachable assignment has no seeds. Raises `BadArgument` for a model of another hand,
    joint limits or fingertips, or in other units.
    """
    check_mixture(mixture, hand)
    check_whole("n_seeds", n_seeds, 1, len(mixture.weights) + 1)
    hand = settle(hand, contacts.points.device)
    mixture = settle(mixture, contacts.points.device)
    size = SEEDS.queried
    firsts = range(0, max(len(contacts), 1), size)
    parts = [_query(hand, contacts[k : k + size], mixture, n_seeds, max_energy) for k in firsts]
    rows = torch.cat([part.row + k for part, k in zip(parts, firsts, strict=True)])
    return dataclasses.replace(join(parts), row=rows)


def _query(
    hand: Hand, contacts: Contacts, mixture: GraspMixture, n_seeds: int, max_energy: float
) -> IKSeeds:
    """Return the seeds of some of the contact sets, as `query_mixture` does for all."""
    code = encode((contacts.points.double(), contacts.normals.double()))
    energy = mixture.energy(code)
    row, assignment = torch.nonzero(energy < max_energy, as_tuple=True)  # NaN is not less
    q = code.q[row, assignment]
    joints = mixture.joints(q)[:, None]
    if n_seeds > 1:
        modes, _ = mixture.modes(q, n_seeds - 1)
        joints = torch.cat([joints, modes], dim=1)
    joints = joints.clamp(hand.lower.to(joints), hand.upper.to(joints))
    joints = joints.flatten(0, 1)
    row = row.repeat_interleave(n_seeds)
    assignment = assignment.repeat_interleave(n_seeds)
    tips, tip_normals = hand.fingertips(joints)
    framed = ~degenerate(tips)
    joints, row, assignment, tips, tip_normals = (
        x[framed] for x in (joints, row, assignment, tips, tip_normals)
    )
    permutation = code.permutation[assignment]
    obj_from_hand = code.obj_from_vf[row, assignment] @ inverse(virtual_frame(tips))  # Eq. (24)
    points = contacts.points.double()[row[:, None], permutation]
    normals = contacts.normals.double()[row[:, None], permutation]
    tip_error = norm(apply(obj_from_hand, tips) - points)
    wrong_side = dot(rotate(obj_from_hand, tip_normals), normals).mean(-1) > SEEDS.wrong_side
    order = lexical_order(row, wrong_side.int(), tip_error.amax(-1))
    seeds = IKSeeds(joints, obj_from_hand, row, permutation, energy[row, assignment], tip_error)
    return seeds[order].to(contacts.points.dtype)
