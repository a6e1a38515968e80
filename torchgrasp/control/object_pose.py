"""Estimates of the object's pose from touches: its displacement from its pose in the plan.

A displacement (6,) is a translation [m] of the contacts' centroid, then a rotation vector [rad]
about it. It is in the frame of the planned hand. While the fingers close, `ContactPlanes` uses the
tangent plane at each planned contact. While the hand stands still, `Localization` compares touched
points and normals with the estimated surface. It also finds displacements along the object's own
surface. f counts the fingertips.
"""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import STILL, Observation
from torchgrasp.geometry.frames import apply, rotation_from_vector
from torchgrasp.geometry.linalg import across, unit


@dataclasses.dataclass(frozen=True)
class ContactPlaneNumbers:
    """Parameters of `ContactPlanes`. All but the last are of its prior: the object's displacement
    before any touch.
    """

    shift: float = 0.01
    """Standard deviation [m] of the shift along the table, or in all directions without one."""
    height: float = 0.001
    """Standard deviation [m] of the shift along the table's normal."""
    turn: float = 0.09
    """Standard deviation [rad] of the rotation about the table's normal, or else about all axes."""
    tilt: float = 0.01
    """Standard deviation [rad] of a tilt on the table."""
    missed: float = 0.025
    """Largest distance [m] by which a finger counts as beyond its contact's plane. A finger that is
    farther beyond has missed the object.
    """


@dataclasses.dataclass(frozen=True)
class LocalizationNumbers:
    """Parameters of `Localization`, the search for the object's displacement from touches."""

    turns: tuple[float, ...] = (-0.24, -0.12, 0.0, 0.12, 0.24)
    """Rotations [rad] about the table's normal that are tried."""
    fine_turns: tuple[float, ...] = (-0.06, 0.0, 0.06)
    """Rotations [rad] that are tried afterwards, relative to the best of `turns`."""
    pitch: float = 0.006
    """Distance [m] between the shifts that are tried; in the fine search it is a quarter of this.
    """
    farthest: float = 0.072
    """Largest shift [m] on each of two axes along the table that is tried."""
    shift: float = 0.03
    """Standard deviation [m] of the shift on each axis before any touch."""
    turn: float = 0.15
    """Standard deviation [rad] of the rotation before any touch."""
    surface: float = 0.004
    """Standard deviation [m] of the estimated surface."""
    normal: float = 0.3
    """Standard deviation of each component of a sensed unit normal."""
    gap: float = 0.001
    """Least distance [m] between the surface and a fingertip in the air."""
    worst: float = 20.0
    """Largest cost (no unit) of one fingertip, so that a wrong touch does not decide."""
    older: float = 4.0
    """Growth of the variance of a touch with each later touch, as a multiple of its own variance. A
    touch moves the object by twice the surface's deviation.
    """
    empty: float = 80.0
    """Cost (no unit) of a pose at which a hand that touched nothing would have touched the object.
    """


PLANES = ContactPlaneNumbers()
SEARCH = LocalizationNumbers()


class ContactPlanes:
    """Estimator of the object's displacement while the fingers close, from the tangent planes at
    its contacts.

    A fingertip that touches measures how far its contact's plane has moved along the normal. The
    measurement has the variance of the shape. A fingertip beyond its plane that touches nothing
    bounds this distance. The estimate is the most probable displacement under a Gaussian prior, in
    the planned hand's frame. The prior has the mean `expected` (6,): translation [m] of the
    contacts' centroid, then rotation vector [rad]. None means a mean of 0.
    """

    def __init__(
        self, reference: ClosingReference, expected: Float[Tensor, "6"] | None = None
    ) -> None:
        gains = reference.gains
        normals = reference.normals
        self.target = gains.target
        self.normals = normals
        self.alive = reference.alive
        self.arms = gains.target - gains.target.mean(0)
        self.rows = torch.cat([normals, torch.linalg.cross(self.arms, normals)], -1)
        self.weight = 1 / torch.einsum("fi,fij,fj->f", normals, gains.covariance, normals)
        self.prior = _prior(reference)
        self.expected = torch.zeros_like(self.prior[0]) if expected is None else expected

    def displacement(
        self, points: Float[Tensor, "f 3"], touching: Bool[Tensor, "f"]
    ) -> Float[Tensor, "6"]:
        """Return the most probable displacement (6,) of the object, in the planned hand's frame.

        First comes the translation [m] of the contacts' centroid, then the rotation vector [rad]
        about it. `points` (f, 3) [m] hold the point of each fingertip that would touch first, in
        the same frame. `touching` marks the fingertips that touch. Both are in the order of the
        hand's fingers.
        """
        off = ((points - self.target) * self.normals).sum(-1)
        beyond = (off - self.rows @ self.expected).clamp_min(-PLANES.missed)
        touching = touching & self.alive
        active = touching
        found = self.expected
        for _ in range(len(off)):
            weight = self.weight * active
            precision = self.prior + self.rows.T @ (weight[:, None] * self.rows)  # (6, 6)
            found = self.expected + torch.linalg.solve(precision, self.rows.T @ (weight * beyond))
            # fingers beyond their planes that touch nothing bound the displacement
            missed = touching | active | (self.alive & (off < self.rows @ found))
            if torch.equal(missed, active):
                break
            active = missed
        return found

    def moved(self, displacement: Float[Tensor, "6"]) -> Float[Tensor, "f 3"]:
        """Return the planned contact points (f, 3) [m] after a `displacement` (6,) of the object.

        Both are in the frame of the planned hand.
        """
        shift = displacement[:3]
        turn = displacement[3:]
        return self.target + shift + torch.linalg.cross(turn.expand_as(self.arms), self.arms)


def _prior(reference: ClosingReference) -> Float[Tensor, "6 6"]:
    """Return the inverse covariance of the object's displacement [m, rad] before any touch: mostly
    along the table.
    """
    eye = torch.eye(3, dtype=reference.normals.dtype)
    place = eye / PLANES.shift**2
    turn = eye / PLANES.turn**2
    if reference.table is not None:
        up = unit(reference.table.normal)
        across = up[:, None] * up
        place = place + across * (PLANES.height**-2 - PLANES.shift**-2)
        turn = eye / PLANES.tilt**2 + across * (PLANES.turn**-2 - PLANES.tilt**-2)
    return torch.block_diag(place, turn)


class Touches:
    """Averages over time of the contact points and normals that a resting hand senses, in the
    planned hand's frame.

    `known` (f,) marks fingertips with a working sensor, and `felt` (f,) those that touch and have
    reported where. f counts fingertips.

    Args:
        reference: the closing plan.
        links: centres and radii (m, 4) [m] of the collision spheres of links. The joint torques
            show that one of these links touches the object. None means that no link has touched it.
        kept: whether fingertips that no longer touch stay in `felt`.
    """

    def __init__(
        self,
        reference: ClosingReference,
        links: Float[Tensor, "m 4"] | None = None,
        kept: bool = False,
    ) -> None:
        self.links = torch.zeros(0, 4, dtype=torch.float64) if links is None else links
        self.kept = kept
        self.points = torch.zeros(reference.normals.shape, dtype=torch.float64)
        self.normals = torch.zeros(reference.normals.shape, dtype=torch.float64)
        self.count = torch.zeros(len(reference.normals), dtype=torch.int64)
        self.tips = reference.gains.target
        self.known = reference.alive
        self.contact = torch.zeros_like(self.known)
        self.palm = STILL
        self.nothing = not len(self.links)

    def add(self, observation: Observation, palm: Float[Tensor, "3"]) -> None:
        """Add one observation to the averages. `palm` (3,) [m] is the palm's displacement from its
        planned pose, in the planned hand's frame.
        """
        sensed = observation.tactile
        if sensed.contact.any():
            finite = torch.isfinite(sensed.points) & torch.isfinite(sensed.normals)
            placed = finite.all(-1) & sensed.contact
            self.points = self.points + torch.where(placed[:, None], sensed.points + palm, 0.0)
            self.normals = self.normals + torch.where(placed[:, None], sensed.normals, 0.0)
            self.count = self.count + placed
            self.nothing = False
        self.tips = observation.tips + palm
        self.contact = sensed.contact
        self.palm = palm

    @property
    def felt(self) -> Bool[Tensor, "f"]:
        """Mask (f,) of the fingertips that touch the object and have reported where they touch.

        If `kept`, those that have stopped touching are included.
        """
        return (self.contact | self.kept) & (self.count > 0)

    def means(self) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
        """Return each fingertip's mean contact point (f, 3) [m], then its mean outward unit normal
        (f, 3). Both are in the planned hand's frame, and 0 without a contact.
        """
        return self.points / self.count.clamp_min(1)[:, None], unit(self.normals)


class Localization:
    """Search for the displacement of the object that best explains a list of touches.

    Each call, without arguments, tries one rotation about the table's normal with shifts along the
    table. Call it until it is `done`; `displacement` is the best one so far. Later touches weigh
    more, because each touch may move the object. If the hand touched nothing (`Touches.nothing`),
    the object is probably not where the hand closed.

    Args:
        reference: the closing plan, with a surface and a table.
        touches: what the hand touched, the earliest first. There is one `Touches` for each time it
            closed, or stopped on its approach.
    """

    def __init__(self, reference: ClosingReference, touches: Sequence[Touches]) -> None:
        assert reference.surface is not None and reference.table is not None
        self.surface = reference.surface
        self.obj_from_hand = reference.obj_from_hand.double()
        self.center = reference.gains.target.mean(0)
        self.radius = reference.hand.tips.radius.double()
        self.up = unit(reference.table.normal.double())
        self.axes = torch.stack(across(self.up))
        self.touches = [*reversed(touches)]
        self.step = 0
        self.cost = torch.inf
        self.shift = torch.zeros(2, dtype=torch.float64)
        self.turn = 0.0
        self.coarse = self.shift, self.turn

    @property
    def done(self) -> bool:
        """Whether the search for the object's pose has tried all rotation angles."""
        return self.step >= len(SEARCH.turns) + len(SEARCH.fine_turns)

    @property
    def displacement(self) -> Float[Tensor, "6"]:
        """The most probable of the displacements (6,) tried so far, in the frame of the planned
        hand.

        First comes the translation [m] of the planned contacts' centroid, then the rotation vector
        [rad] about this centroid.
        """
        return torch.cat([self.shift @ self.axes, self.turn * self.up])

    def __call__(self) -> None:
        """Try one rotation angle with a grid of translations; the last calls search finely around
        the best result.
        """
        fine = self.step - len(SEARCH.turns)
        if fine < 0:
            shifts = _square(SEARCH.farthest, SEARCH.pitch)
            turn = SEARCH.turns[self.step]
        else:
            if fine == 0:
                self.coarse = self.shift, self.turn
            middle, facing = self.coarse
            pitch = SEARCH.pitch / 4
            shifts = middle + _square(SEARCH.pitch - pitch, pitch)
            turn = facing + SEARCH.fine_turns[fine]
        costs = self._costs(shifts, turn)
        best = int(costs.argmin())
        if float(costs[best]) < self.cost:
            self.cost = float(costs[best])
            self.shift = shifts[best].clone()
            self.turn = turn
        self.step += 1

    def _costs(self, shifts: Float[Tensor, "m 2"], turn: float) -> Float[Tensor, "m"]:
        """Return the negative log-probability of each translation [m] along the table, for one
        rotation `turn` [rad].
        """
        cost = (shifts / SEARCH.shift).square().sum(-1) + (turn / SEARCH.turn) ** 2  # (m,)
        for age, touches in enumerate(self.touches):
            cost = cost + self._misfit(touches, shifts, turn) / (1 + SEARCH.older * age)
            if touches.nothing:
                # the object is probably not where the hand was
                off = (shifts - self.axes @ touches.palm) / SEARCH.shift
                cost = cost + SEARCH.empty * torch.exp(-2 * off.square().sum(-1))
        return 0.5 * cost

    def _misfit(
        self, touches: Touches, shifts: Float[Tensor, "m 2"], turn: float
    ) -> Float[Tensor, "m"]:
        """Return the misfit of `touches` (twice a negative log-probability) at each translation
        [m], for one rotation [rad].
        """
        felt = touches.felt
        points, normals = touches.means()
        rotation = rotation_from_vector(turn * self.up)
        there = torch.where(felt[:, None], points, touches.tips) - self.center
        moved = (shifts @ self.axes)[:, None]  # (m, 1, 3)
        # where the tips were relative to the object before it moved: (m, f, 3)
        before = (there - moved) @ rotation + self.center
        distance, gradient = self.surface.query(apply(self.obj_from_hand, before))
        outward = unit(gradient @ self.obj_from_hand[:3, :3] @ rotation.T)
        facing = ((outward - normals) / SEARCH.normal).square().sum(-1)
        touched = _bounded_cost(distance) + facing
        # a tip in the air is not in the object; a tip that touches somewhere, or is blind, may be
        inside = _bounded_cost((self.radius + SEARCH.gap - distance).clamp_min(0.0))
        untouched = torch.where(touches.contact | ~touches.known, 0.0, inside)
        fit = torch.where(felt, touched, untouched).sum(-1)
        if len(touches.links):
            # one of the spheres touches
            before = (touches.links[:, :3] - self.center - moved) @ rotation + self.center
            off = self.surface.query(apply(self.obj_from_hand, before))[0] - touches.links[:, 3]
            fit = fit + _bounded_cost(off.abs().amin(-1))
        return fit


def _bounded_cost(distance: Float[Tensor, "*m"]) -> Float[Tensor, "*m"]:
    """Return twice the negative log-probability of a distance [m] to the surface, bounded."""
    return (distance / SEARCH.surface).square().clamp_max(2 * SEARCH.worst)


def _square(half: float, pitch: float) -> Float[Tensor, "m 2"]:
    """Return the points of a square grid of spacing `pitch` from -half to half on both axes [m]."""
    most = round(half / pitch)
    line = torch.arange(-most, most + 1, dtype=torch.float64) * pitch
    return torch.cartesian_prod(line, line)
