"""Grasp solvers on fixed contacts, which refine initial guesses (seeds) in rounds; also the paper's
COBYLA solver.

b counts contact sets (one contact for each fingertip), g seeds or grasps, f fingertips, h actuated
joints.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchgrasp.foundation.base import (
    Batch,
    at_once,
    flatnonzero,
    join,
    lexical_order,
    map_tensors,
    rank_in_group,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import Status
from torchgrasp.geometry.frames import apply, degenerate, inverse, virtual_frame
from torchgrasp.geometry.linalg import norm
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import map_points
from torchgrasp.ik.candidates import (
    PAPER_TOLERANCE,
    TIP_PENETRATION,
    TIP_TOLERANCE,
    GraspCandidates,
    GraspProblem,
    check_candidates,
)
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, table_clearance
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.refine import ITERATIONS, grasp_residuals, refine, tip_targets
from torchgrasp.values.planning import Contacts, Grasps, IKSeeds

Result = TypeVar("Result", bound=Batch)


@dataclasses.dataclass(frozen=True)
class CobylaNumbers:
    """Parameters of the paper's grasp solver, SciPy's COBYLA."""

    angle: float = 0.01
    """Unit of the variables [rad]: a fingertip moves by about a millimetre, as the distances do."""
    far: float = 20.0
    """Clearance [mm] above which clearances are not distinguished."""
    end: float = 0.05
    """Trust region, in units of the variables, at which COBYLA stops."""
    start: float = 10.0
    """Trust region at the start, in units of the variables."""
    evaluations: int = 400
    """Most evaluations of one run."""
    together: int = 10
    """Number of initial guesses that are tried at a time."""
    grasps: int = 10
    """Number of executable grasps that are enough."""
    seeds: int = 300
    """Most initial guesses that are tried."""


COBYLA = CobylaNumbers()
ROWS = 256  # seeds whose costs are computed at a time, which bounds the memory


def assign(contacts: Contacts, seeds: IKSeeds) -> Contacts:
    """Return the contact set of each initial guess, with its contacts reordered so that contact i
    belongs to finger i.

    `contacts` are all sets; `seeds.row` holds the index of each guess's set.
    """
    return map_tensors(lambda x: x[seeds.row[:, None], seeds.permutation], contacts)


class Attempts(Generic[Result]):
    """The results of all refined initial guesses so far, and a mask of the contact sets without a
    good one.

    `unsolved` is this mask of the b contact sets; `solves` returns a mask (k,) of the good ones
    among k results. `results` are the added groups of results, such as `Grasps`, and `rows` holds
    for each group the index of each result's contact set.
    """

    def __init__(self, unsolved: Bool[Tensor, "b"], solves: Callable[[Result], Bool[Tensor, "k"]]):
        self.unsolved = unsolved
        self.solves = solves
        self.results = list[Result]()
        self.rows = list[Tensor]()

    def add(self, results: Result, row: Int[Tensor, "k"]) -> None:
        """Add k `results`; `row` holds the index of the contact set of each."""
        self.results.append(results)
        self.rows.append(row)
        self.unsolved = self.unsolved.index_fill(0, row[self.solves(results)], False)

    def choose(self, seeds: IKSeeds, rank: Int[Tensor, "g"], first: int, count: int) -> IKSeeds:
        """Return the initial guesses of unsolved contact sets whose `rank` within the set is from
        `first` to `first + count - 1`.
        """
        return seeds[(rank >= first) & (rank < first + count) & self.unsolved[seeds.row]]

    def refine(
        self,
        seeds: IKSeeds,
        rank: Int[Tensor, "g"],
        counts: Sequence[int],
        refine: Callable[[IKSeeds], Result],
    ) -> None:
        """In round k, refine the next `counts[k]` initial guesses of each unsolved contact set, and
        add the results.

        `rank` is the rank of each guess, from 0, among those of its contact set. `refine` returns
        one result for each of the guesses that it is given.
        """
        first = 0
        for count in counts:
            chosen = self.choose(seeds, rank, first, count)
            first += count
            if len(chosen) or not self.results:
                self.add(refine(chosen), chosen.row)

    def best(self, keys: Callable[[Result], tuple[Tensor, ...]]) -> tuple[Result, Int[Tensor, "t"]]:
        """Return the best result of each of t contact sets with results, then the index of that
        set.

        `keys` returns tensors (k,) for k results. The best result has the least first key; in a tie
        the next key decides.
        """
        results = join(self.results)
        row = torch.cat(self.rows)
        first = rank_in_group(row, *keys(results)) == 0
        return results[first], row[first]


def executable(grasps: Grasps) -> Bool[Tensor, "g"]:
    """Return a mask of the grasps that passed every check (`Status.OK`)."""
    return grasps.status == Status.OK


def best_grasps(attempts: Attempts[Grasps]) -> tuple[Grasps, Int[Tensor, "t"]]:
    """Return the best grasp of each of t contact sets with results, then the index of that set.

    An executable grasp comes first, then one that failed on valid contacts, then others; in a tie
    the higher score decides.
    """

    def keys(grasps: Grasps) -> tuple[Tensor, Tensor]:
        failed = ~executable(grasps)
        bad_contacts = failed & (grasps.status < Status.OUT_OF_REACH)
        return failed.int() + bad_contacts.int(), -grasps.score

    return attempts.best(keys)


def best_first(grasps: Grasps) -> Grasps:
    """Return grasps sorted: executable grasps before failed grasps, both by decreasing score."""
    return grasps[lexical_order((~executable(grasps)).int(), -grasps.score)]


def refine_on_contacts(
    problem: GraspProblem, seeds: IKSeeds, steps: int = ITERATIONS, cobyla: bool = False
) -> Grasps:
    """Return a checked grasp for each initial guess, refined on its fixed contacts.

    The solver takes at most `steps` steps. `problem` holds the contact sets, of which `seeds.row`
    holds indices. A grasp's `status` is that of the first check that it fails. With `cobyla`, the
    paper's solver and checks are used, and `steps` is not used.
    """
    contacts = assign(problem.contacts, seeds)
    start = Configuration(seeds.joints, seeds.obj_from_hand)
    own = problem.rows(seeds.row)
    status = torch.full_like(seeds.row, Status.OK)
    if cobyla:
        configuration = refine_by_cobyla(problem.hand, start, contacts, problem.world)
    else:
        configuration = refine(problem.hand, start, contacts, own.world, steps=steps)
    candidates = GraspCandidates(
        configuration, contacts, own.certificate, seeds.permutation, status
    )
    tolerance = PAPER_TOLERANCE if cobyla else TIP_TOLERANCE
    return check_candidates(own, candidates, rolling=not cobyla, tolerance=tolerance)


def try_best_seeds(
    problem: GraspProblem, seeds: IKSeeds, steps: int = ITERATIONS
) -> Attempts[Grasps]:
    """Return the checked grasps of the first two initial guesses of each contact set.

    Each guess is refined on its fixed contacts by at most `steps` solver steps.
    """
    attempts = Attempts(torch.ones_like(problem.certificate.closed), executable)
    attempts.refine(
        seeds, rank_in_group(seeds.row), (2,), partial(refine_on_contacts, problem, steps=steps)
    )
    return attempts


def seed_costs(problem: GraspProblem, seeds: IKSeeds) -> Float[Tensor, "g"]:
    """Return the cost [mm2] of each initial guess before refinement: the sum of its squared
    residuals.

    These are the `grasp_residuals`: weighted errors of tip positions, pad directions and
    clearances.
    """
    costs = [seeds.energy[:0]]
    every = torch.arange(len(seeds), device=seeds.row.device)
    for rows in every.split(at_once(seeds.row, ROWS)):
        part = seeds[rows]
        start = Configuration(part.joints, part.obj_from_hand)
        contacts = assign(problem.contacts, part)
        target = tip_targets(problem.hand, contacts)
        world = problem.world.rows(part.row)
        residual, _ = grasp_residuals(
            problem.hand, start, target, contacts.normals, world, tips_touch=True
        )
        costs.append(residual.square().sum(1))
    return torch.cat(costs)


@checked
def solve_contact_first(problem: GraspProblem, seeds: IKSeeds) -> Grasps:
    """Return a checked grasp on fixed contacts for each contact set with initial guesses (`seeds`),
    best grasp first.

    The two guesses of each set with the least errors are refined. If both fail, the next four are
    refined.
    """
    seeds = problem.drop_unreachable(seeds)
    attempts = Attempts(torch.ones_like(problem.certificate.closed), executable)
    rank = rank_in_group(seeds.row, seed_costs(problem, seeds))
    attempts.refine(seeds, rank, (2, 4), partial(refine_on_contacts, problem))
    return best_first(best_grasps(attempts)[0])


def refine_by_cobyla(
    hand: Hand, start: Configuration, contacts: Contacts, world: CollisionWorld
) -> Configuration:
    """Return hand configurations moved onto three contacts each by SciPy's COBYLA.

    The joints in `start` are the initial ones; its poses are not used. `contacts` are one set for
    each configuration, and the links keep clear of the `world`.
    """
    if not len(start):
        return start
    rows = [
        CobylaRun(hand, q, p, world).solve()
        for q, p in zip(start.joints, contacts.points, strict=True)
    ]
    return join(rows).to(start.joints.dtype)


class CobylaRun:
    """One run of SciPy's COBYLA from initial `joints` [rad] onto three contact `points` [m].

    The points are in the object's frame; `world` holds what the hand must not touch. l counts the
    hand's links. The values at the last evaluated point are cached.
    """

    def __init__(
        self,
        hand: Hand,
        joints: Float[Tensor, "h"],
        points: Float[Tensor, "3 3"],
        world: CollisionWorld,
    ):
        self.hand = hand
        self.world = world
        self.first = joints.double()
        self.points = points.double()
        spheres = hand.collision_spheres
        groups = [(spheres.finger == k) & ~spheres.touching for k in (-2, -1, 0, 1, 2)]
        self.groups = [flatnonzero(group) for group in groups if bool(group.any())]
        self.last: tuple[bytes, float, np.ndarray] | None = None

    def place(
        self, x: np.ndarray
    ) -> tuple[Tensor, Float[Tensor, "3 4 l 1"], Float[Tensor, "4 4"], bool]:
        """Return joints [rad], link frames, hand pose [m] by Eq. (24), and whether the tips span a
        frame.

        `x` are COBYLA's variables: the changes of the joints in units of `COBYLA.angle`. The link
        frames (3 x 4) [m] are in the hand's frame.
        """
        hand = self.hand
        step = COBYLA.angle * torch.from_numpy(np.array(x, dtype=float)).to(self.points)
        joints = (self.first + step).clamp(hand.lower.to(step), hand.upper.to(step))
        frames = hand.tree.frames(hand.expand_joints(joints)[:, None].contiguous())
        tips = self.tips(frames)
        if bool(degenerate(tips)):
            return joints, frames, torch.eye(4, device="cpu").to(tips), False
        return joints, frames, virtual_frame(self.points) @ inverse(virtual_frame(tips)), True

    def tips(self, frames: Float[Tensor, "3 4 l 1"]) -> Float[Tensor, "3 3"]:
        """Return the contact points [m] of the fingertips in the hand's frame, given the link
        `frames`.
        """
        tips = self.hand.tips
        return map_points(frames.index_select(2, tips.index), tips.contact)[..., 0].T

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the sum of the distances [mm] of tips from contacts, then the constraints, which
        must be >= 0.

        These are the clearances [mm] less 0.5 mm, at COBYLA's variables `x`.
        """
        key = np.asarray(x).tobytes()
        if self.last is None or self.last[0] != key:
            _, frames, pose, framed = self.place(x)
            error = norm(apply(pose, self.tips(frames)) - self.points).sum() / MILLIMETRE
            room = torch.stack(self.clearances(frames, pose)) / MILLIMETRE
            room = room.clamp_max(COBYLA.far) - 0.5
            self.last = key, float(error) if framed else 1e3, room.cpu().numpy()
        return self.last[1:]

    def clearances(
        self, frames: Float[Tensor, "3 4 l 1"], pose: Float[Tensor, "4 4"]
    ) -> list[Float[Tensor, ""]]:
        """Return least clearances [m] of the hand from itself and from the world.

        They are in this order: between the hand's own links; from the object to the palm, to each
        finger and to each fingertip; from the table to the hand; from obstacles to the hand. Those
        for which the world has no part are left out. `frames` are the link frames in the hand's
        frame, and `pose` [m] is the hand's in the object's frame.
        """
        world = self.world
        spheres = self.hand.collision_spheres
        radius = spheres.radius.to(pose)
        local = map_points(frames.index_select(2, spheres.link_index), spheres.center)[..., 0].T
        centres = apply(pose, local)
        found = [self.hand.self_collision.clearance(frames, COBYLA.far * MILLIMETRE)[0]]
        if world.field is not None:
            outside = world.field.query(centres)[0] - radius
            found += [outside[group].amin() for group in self.groups]
            found += list((outside[spheres.touching] + TIP_PENETRATION).unbind())
        if world.plane is not None:
            found.append(table_clearance(centres, radius, world.plane))
        if world.obstacles is not None and world.guarded:
            found.append((world.obstacles.field.query(centres)[0] - radius).amin())
        return found

    def solve(self) -> Configuration:
        """Return the configuration at which COBYLA stops.

        Raises `DegenerateContacts` for contacts on a line.
        """
        from scipy.optimize import NonlinearConstraint, minimize

        first = self.first.cpu().numpy()
        limits = [
            (b.double().cpu().numpy() - first) / COBYLA.angle
            for b in (self.hand.lower, self.hand.upper)
        ]
        solution = minimize(
            lambda x: self.evaluate(x)[0],
            np.zeros(self.hand.dof),
            method="COBYLA",
            bounds=list(zip(*limits, strict=True)),
            constraints=[NonlinearConstraint(lambda x: self.evaluate(x)[1], 0.0, np.inf)],
            tol=COBYLA.end,
            options={"rhobeg": COBYLA.start, "maxiter": COBYLA.evaluations},
        )
        joints, _, pose, _ = self.place(solution.x)
        return Configuration(joints[None], pose[None])


def solve_as_paper(problem: GraspProblem, seeds: IKSeeds) -> Grasps:
    """Return a checked grasp for each initial guess that was tried, as in the paper, best first.

    The guesses are tried ten at a time, in the order of their contact sets, until 10 grasps are
    executable or 300 were tried.
    """
    seeds = problem.drop_unreachable(seeds)
    tried = list[Grasps]()
    step = COBYLA.together
    for first in range(0, max(min(len(seeds), COBYLA.seeds), 1), step):
        tried.append(refine_on_contacts(problem, seeds[first : first + step], cobyla=True))
        if int(executable(join(tried)).sum()) >= COBYLA.grasps:
            break
    return best_first(join(tried))
