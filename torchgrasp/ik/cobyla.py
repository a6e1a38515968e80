"""The paper's refinement (Sec. 6.3): COBYLA on the sum of the tip distances, one grasp at a time.

Fingertips touch with their contact points, in any direction. Collisions are constraints. The pose moves with the joints
by Eq. (24), which every configuration without distances satisfies. With six variables of its own COBYLA stops
centimetres away: its linear models do not see the kink of a distance at zero.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.base import join
from torchgrasp.errors import Status
from torchgrasp.geometry.frames import apply, degenerate, inverse, virtual_frame
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import map_points
from torchgrasp.ik.attempts import Attempts, assign, best_first, best_grasps, executable
from torchgrasp.ik.candidates import (
    PAPER_TOLERANCE,
    TIP_PENETRATION,
    GraspCandidates,
    GraspProblem,
    check_candidates,
)
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, along
from torchgrasp.ik.configuration import Configuration
from torchgrasp.ik.ranking import rank_in_group
from torchgrasp.values import Contacts, Grasps, IKSeeds

ANGLE = 0.01  # unit of the variables [rad]: a fingertip moves by about a millimetre, the unit of distances
FAR = 20.0  # clearance [mm] above which clearances are not distinguished


def refine_by_cobyla(
    hand: Hand, configuration: Configuration, contacts: Contacts, world: CollisionWorld
) -> Configuration:
    """Return the configurations at which COBYLA stops; only the joints of the starts are used."""
    if not len(configuration):
        return configuration
    rows = [CobylaRun(hand, q, p, world).solve() for q, p in zip(configuration.joints, contacts.points, strict=True)]
    return join(rows).to(configuration.joints.dtype)


class CobylaRun:
    """One run from `joints` onto three points. SciPy asks for distance and clearances in turn, so values are kept."""

    def __init__(self, hand: Hand, joints: Float[Tensor, "h"], points: Float[Tensor, "3 3"], world: CollisionWorld):
        self.hand, self.world = hand, world
        self.first, self.points = joints.double(), points.double()
        spheres = hand.collision_spheres
        groups = [(spheres.finger == k) & ~spheres.touching for k in (-2, -1, 0, 1, 2)]
        self.groups = [torch.nonzero(group)[:, 0] for group in groups if bool(group.any())]
        self.last: tuple[bytes, float, np.ndarray] | None = None

    def place(self, x: np.ndarray) -> tuple[Tensor, Float[Tensor, "3 4 l 1"], Float[Tensor, "4 4"], bool]:
        """Return joints within their limits, the links' frames in the hand, the pose by Eq. (24), whether it exists."""
        step = ANGLE * torch.from_numpy(np.array(x, dtype=float)).to(self.points)
        joints = (self.first + step).clamp(self.hand.lower.to(step), self.hand.upper.to(step))
        frames = self.hand.tree.frames(self.hand.expand_joints(joints)[:, None].contiguous())
        tips = self.tips(frames)
        if bool(degenerate(tips)):
            return joints, frames, torch.eye(4).to(tips), False
        return joints, frames, virtual_frame(self.points) @ inverse(virtual_frame(tips)), True

    def tips(self, frames: Float[Tensor, "3 4 l 1"]) -> Float[Tensor, "3 3"]:
        """Return the contact points of the fingertips in the hand [m]."""
        return map_points(frames.index_select(2, self.hand.tips.index), self.hand.tips.contact)[..., 0].T

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the sum of the tip distances, and the clearances less half a millimetre, which must be >= 0 [mm]."""
        key = np.asarray(x).tobytes()
        if self.last is None or self.last[0] != key:
            _, frames, pose, framed = self.place(x)
            error = torch.linalg.vector_norm(apply(pose, self.tips(frames)) - self.points, dim=-1).sum() / MILLIMETRE
            room = (torch.stack(self.clearances(frames, pose)) / MILLIMETRE).clamp_max(FAR) - 0.5
            self.last = key, float(error) if framed else 1e3, room.cpu().numpy()
        return self.last[1:]

    def clearances(self, frames: Float[Tensor, "3 4 l 1"], pose: Float[Tensor, "4 4"]) -> list[Float[Tensor, ""]]:
        """Return clearances [m]: links from each other; palm, fingers, and tips from the object; all from the rest."""
        spheres, radius = self.hand.collision_spheres, self.hand.collision_spheres.radius.to(pose)
        local = map_points(frames.index_select(2, spheres.link_index), spheres.center)[..., 0].T
        centres = apply(pose, local)
        found = [self.hand.self_collision.clearance(frames, FAR * MILLIMETRE)[0]]
        if self.world.field is not None:
            outside = self.world.field.query(centres)[0] - radius
            found += [outside[group].amin() for group in self.groups]
            found += list((outside[spheres.touching] + TIP_PENETRATION).unbind())
        if self.world.plane is not None:
            found.append((along(centres, self.world.plane) - radius).amin() - self.world.plane.offset)
        if self.world.obstacles is not None and self.world.guarded:
            found.append((self.world.obstacles.field.query(centres)[0] - radius).amin())
        return found

    def solve(self) -> Configuration:
        """Return the configuration where COBYLA stops; `DegenerateContacts` for contacts in a line."""
        from scipy.optimize import NonlinearConstraint, minimize

        first = self.first.cpu().numpy()
        limits = [(b.double().cpu().numpy() - first) / ANGLE for b in (self.hand.lower, self.hand.upper)]
        solution = minimize(
            lambda x: self.evaluate(x)[0],
            np.zeros(self.hand.dof),
            method="COBYLA",
            bounds=list(zip(*limits, strict=True)),
            constraints=[NonlinearConstraint(lambda x: self.evaluate(x)[1], 0.0, np.inf)],
            tol=0.05,
            options={"rhobeg": 10.0, "maxiter": 400},
        )
        joints, _, pose, _ = self.place(solution.x)
        return Configuration(joints[None], pose[None])


def solve_as_paper(problem: GraspProblem, seeds: IKSeeds) -> Grasps:
    """Return a checked grasp for each triple that was tried, best first.

    Triples are tried five at a time, two seeds each, until 10 are executable or 30 were tried.
    """
    seeds = problem.drop_unreachable(seeds)
    attempts, rows = Attempts(torch.ones_like(problem.certificate.closed), executable), seeds.row.unique()

    def refine(seeds: IKSeeds) -> Grasps:
        contacts, start = assign(problem.contacts, seeds), Configuration(seeds.joints, seeds.obj_from_hand)
        configuration = refine_by_cobyla(problem.hand, start, contacts, problem.world)
        certificate, status = problem.certificate[seeds.row], torch.full_like(seeds.row, Status.OK)
        candidates = GraspCandidates(configuration, contacts, certificate, seeds.permutation, status)
        return check_candidates(problem, candidates, rolling=False, tolerance=PAPER_TOLERANCE)

    for some in rows.split(5):  # one empty part without rows
        chosen = seeds[torch.isin(seeds.row, some)]
        attempts.refine(chosen, _rank(problem, chosen), [1, 1], refine)
        results = join(attempts.results)
        if int(executable(results).sum()) >= 10 or len(results) >= 30:
            break
    return best_first(best_grasps(attempts)[0])


def _rank(problem: GraspProblem, seeds: IKSeeds) -> Int[Tensor, "g"]:
    """Return each seed's rank within its triple by its deepest collision, the least first."""
    contacts, still = assign(problem.contacts, seeds), np.zeros(problem.hand.dof)
    runs = [CobylaRun(problem.hand, q, p, problem.world) for q, p in zip(seeds.joints, contacts.points, strict=True)]
    deepest = [max(0.0, -float(run.evaluate(still)[1].min())) for run in runs]
    return rank_in_group(seeds.row, torch.tensor(deepest, dtype=torch.float64, device=seeds.row.device))
