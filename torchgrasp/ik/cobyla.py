"""The paper's grasp solver (Sec. 6.3): SciPy's COBYLA moves the fingertips onto three contacts.

h counts actuated joints. The hand's pose follows from its joints by Eq. (24).
"""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.base import flatnonzero, join
from torchgrasp.foundation.lazy import optimize
from torchgrasp.geometry.frames import apply, degenerate, inverse, virtual_frame
from torchgrasp.geometry.linalg import norm
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.kinematics import map_points
from torchgrasp.ik.candidates import TIP_PENETRATION
from torchgrasp.ik.clearance import MILLIMETRE, CollisionWorld, table_clearance
from torchgrasp.ik.configuration import Configuration
from torchgrasp.values.planning import Contacts


@dataclasses.dataclass(frozen=True)
class CobylaNumbers:
    """Parameters of the paper's grasp solver, SciPy's COBYLA."""

    angle: float = 0.01
    """Unit [rad] of the joint variables: it moves a fingertip by about a millimetre, the unit of
    distances.
    """
    far: float = 20.0
    """Clearance [mm] above which clearances count as equal."""
    end: float = 0.05
    """Radius of COBYLA's trust region, in units of the variables, at which it stops."""
    start: float = 10.0
    """Radius of COBYLA's trust region at the start, in units of the variables."""
    evaluations: int = 400
    """Greatest number of evaluations in one run of COBYLA."""
    together: int = 10
    """Number of initial guesses that are tried at a time."""
    grasps: int = 10
    """Number of executable grasps after which no further initial guesses are tried."""
    seeds: int = 300
    """Greatest number of initial guesses that are tried."""


COBYLA = CobylaNumbers()


def refine_by_cobyla(
    hand: Hand, start: Configuration, contacts: Contacts, world: CollisionWorld
) -> Configuration:
    """Return hand configurations moved onto three contacts each by SciPy's COBYLA.

    The joints in `start` are the initial ones; its poses are not used. `contacts` [m] are one set
    for each configuration, with contact i for finger i. The links keep clear of the `world`, which
    is in the frame of the contacts. Raises `DegenerateContacts` for contacts on a line.
    """
    if not len(start):
        return start
    rows = [
        CobylaRun(hand, q, p, world).solve()
        for q, p in zip(start.joints, contacts.points, strict=True)
    ]
    return join(rows).to(start.joints.dtype)


class CobylaRun:
    """One run of SciPy's COBYLA, which moves the three fingertips of a hand onto three contact
    points.

    The variables are the h actuated joints. The hand's pose follows from them: it aligns the
    triangle of the fingertips with that of the contacts (Eq. 24 of the paper). The sum of the
    distances between fingertips and contacts is minimised, while the hand keeps clear of itself and
    the world. l counts the hand's links. The values at the last evaluated joints are cached.

    Args:
        hand: a hand with three grasping fingers.
        joints: initial actuated joints (h,) [rad or m].
        points: contact points (3, 3) [m] in the object's frame; point i is for finger i.
        world: object, table and obstacles that the hand must not touch, in the object's frame.
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
        self.groups = [flatnonzero(group) for group in groups if group.any()]
        self.last: tuple[bytes, float, np.ndarray] | None = None

    def place(
        self, x: np.ndarray
    ) -> tuple[Tensor, Float[Tensor, "3 4 l 1"], Float[Tensor, "4 4"], bool]:
        """Return joints [rad or m], link frames, hand pose [m] by Eq. (24), and whether the tips
        span a frame.

        `x` are COBYLA's variables: the changes of the joints in units of 0.01 rad (`COBYLA.angle`).
        The link frames (3 x 4) [m] are in the hand's frame, and its pose is in the object's frame.
        If the tips are on a line, they span no frame, and the pose is the identity.
        """
        hand = self.hand
        step = COBYLA.angle * torch.from_numpy(np.array(x, dtype=float)).to(self.points)
        joints = (self.first + step).clamp(hand.lower.to(step), hand.upper.to(step))
        frames = hand.tree.frames(hand.expand_joints(joints)[:, None].contiguous())
        tips = self.tips(frames)
        if degenerate(tips):
            return joints, frames, torch.eye(4, device="cpu").to(tips), False
        return joints, frames, virtual_frame(self.points) @ inverse(virtual_frame(tips)), True

    def tips(self, frames: Float[Tensor, "3 4 l 1"]) -> Float[Tensor, "3 3"]:
        """Return the contact points [m] of the three fingertips in the hand's frame.

        `frames` (3 x 4) [m] are the poses of the links in this frame.
        """
        tips = self.hand.tips
        return map_points(frames.index_select(2, tips.index), tips.contact)[..., 0].T

    def evaluate(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the sum of the distances [mm] of tips from contacts, then the constraints [mm],
        which must be >= 0.

        The constraints are the clearances, at most 20 mm (`COBYLA.far`), less 0.5 mm. `x` are
        COBYLA's variables: changes of the joints. The sum is 1000 if the tips are on a line.
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
        """Return the list of the least clearances [m] of the hand from itself and from the world.

        First is that between the hand's own links. Then follow those from the object to the palm,
        to each finger and to each fingertip. To those of the fingertips 2 mm (`TIP_PENETRATION`)
        are added, since tips may press into the object. Last are those from the table and from
        obstacles to the hand. Those from an object, a table or obstacles that do not exist are left
        out. `frames` are the link frames in the hand's frame, and `pose` [m] is the hand's in the
        object's frame.
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
        first = self.first.cpu().numpy()
        limits = [
            (b.double().cpu().numpy() - first) / COBYLA.angle
            for b in (self.hand.lower, self.hand.upper)
        ]
        solution = optimize.minimize(
            lambda x: self.evaluate(x)[0],
            np.zeros(self.hand.dof),
            method="COBYLA",
            bounds=list(zip(*limits, strict=True)),
            constraints=[optimize.NonlinearConstraint(lambda x: self.evaluate(x)[1], 0.0, np.inf)],
            tol=COBYLA.end,
            options={"rhobeg": COBYLA.start, "maxiter": COBYLA.evaluations},
        )
        joints, _, pose, _ = self.place(solution.x)
        return Configuration(joints[None], pose[None])
