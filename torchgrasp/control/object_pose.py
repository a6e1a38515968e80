"""Estimates of the object's pose from touches: how far the object is displaced from its pose in the
plan.

While the fingers close, `ContactPlanes` uses the tangent plane at each planned contact. While the
hand stands still, `Localization` compares touched points and normals with the estimated surface, so
that it also finds displacements along the object's own surface.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import STILL, Observation
from torchgrasp.geometry.frames import apply, rotation_from_vector
from torchgrasp.geometry.linalg import across, unit

TURNS = (-0.24, -0.12, 0.0, 0.12, 0.24)
FINE_TURNS = (-0.06, 0.0, 0.06)
"""Turns [rad] of the object that `Localization` tries, and turns about the best of them."""
# distance [m] between the displacements that `Localization` tries, and the largest
PITCH = 0.006
FARTHEST = 0.072


class ContactPlanes:
    """Estimate the object's displacement while the fingers close, from the tangent planes at its
    contacts.

    A fingertip that touches measures how far its contact's plane has moved along the normal, with
    the variance of the shape. A fingertip beyond its plane that touches nothing bounds this
    distance. The estimate is the most probable displacement under a Gaussian prior with the mean
    `expected` [m, rad] (by default 0), in the planned hand's frame.
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
        """Return the most probable displacement: translation of the contacts' centroid [m],
        rotation about it [rad].

        `points` [m] are the points of the fingertips that would touch first; `touching` marks
        fingertips that touch.
        """
        off = ((points - self.target) * self.normals).sum(-1)
        beyond = (off - self.rows @ self.expected).clamp_min(
            -0.025
        )  # a finger farther on has missed the object
        touching = touching & self.alive
        active = touching
        found = self.expected
        for _ in range(len(off)):
            weight = self.weight * active
            found = self.expected + torch.linalg.solve(
                self.prior + self.rows.T @ (weight[:, None] * self.rows),
                self.rows.T @ (weight * beyond),
            )
            missed = touching | active | (self.alive & (off < self.rows @ found))
            if torch.equal(missed, active):
                break
            active = missed
        return found

    def moved(self, displacement: Float[Tensor, "6"]) -> Float[Tensor, "f 3"]:
        """Return the planned contact points [m] after a displacement [m, rad] of the object."""
        shift = displacement[:3]
        turn = displacement[3:]
        return self.target + shift + torch.linalg.cross(turn.expand_as(self.arms), self.arms)


def _prior(reference: ClosingReference) -> Float[Tensor, "6 6"]:
    """Return the inverse covariance of the object's displacement before any touch: mostly along the
    table.
    """
    # [m, m, rad, rad]
    shift_std = 0.01
    height_std = 0.001
    turn_std = 0.09
    tilt_std = 0.01
    eye = torch.eye(3, dtype=reference.normals.dtype)
    place = eye / shift_std**2
    turn = eye / turn_std**2
    if reference.table is not None:
        up = unit(reference.table.normal)
        across = up[:, None] * up
        place = place + across * (height_std**-2 - shift_std**-2)
        turn = eye / tilt_std**2 + across * (turn_std**-2 - tilt_std**-2)
    return torch.block_diag(place, turn)


class Touches:
    """Time averages of the contact points and normals that a resting hand senses, in the frame of
    the planned hand.

    `known` marks fingertips with a working sensor, `felt` marks fingertips that touch and have
    reported where. With `links`, fingertips that no longer touch count, too; if `links` holds
    spheres (centres and radii [m]), one touches.
    """

    def __init__(
        self, reference: ClosingReference, links: Float[Tensor, "m 4"] | None = None
    ) -> None:
        self.links = torch.zeros(0, 4) if links is None else links
        self.kept = links is not None
        self.points, self.normals = torch.zeros(2, *reference.normals.shape, dtype=torch.float64)
        self.count = torch.zeros(len(reference.normals), dtype=torch.int64)
        self.tips = reference.gains.target
        self.known = reference.alive
        self.contact, self.palm, self.nothing = (
            torch.zeros_like(self.known),
            STILL,
            not len(self.links),
        )

    def add(self, observation: Observation, palm: Float[Tensor, "3"]) -> None:
        """Add one observation to the averages; `palm` [m] is how far the palm is displaced from its
        plan.
        """
        sensed = observation.tactile
        if bool(sensed.contact.any()):
            placed = (
                torch.isfinite(sensed.points).all(-1)
                & torch.isfinite(sensed.normals).all(-1)
                & sensed.contact
            )
            self.points = self.points + torch.where(placed[:, None], sensed.points + palm, 0.0)
            self.normals = self.normals + torch.where(placed[:, None], sensed.normals, 0.0)
            self.count = self.count + placed
            self.nothing = False
        self.tips = observation.tips + palm
        self.contact = sensed.contact
        self.palm = palm

    @property
    def felt(self) -> Bool[Tensor, "f"]:
        """A mask of the fingertips that touch the object and have reported where they touch."""
        return (self.contact | self.kept) & (self.count > 0)

    def means(self) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
        """Return each fingertip's mean contact point [m] and unit normal; zero for fingertips
        without contact.
        """
        return self.points / self.count.clamp_min(1)[:, None], unit(self.normals)


class Localization:
    """Search for the object displacement that best explains the `touches`; each call tries one
    rotation angle.

    The last touches tell most, because each touch may move the object. Where the hand closed on
    `nothing`, the object is probably not. `displacement` holds the translation of the contacts'
    centroid [m] and the rotation about it [rad].
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
        return self.step >= len(TURNS) + len(FINE_TURNS)

    @property
    def displacement(self) -> Float[Tensor, "6"]:
        """The best displacement of the object so far: translation [m] and rotation vector [rad]."""
        return torch.cat([self.shift @ self.axes, self.turn * self.up])

    def __call__(self) -> None:
        """Try one rotation angle with a grid of translations; the last calls search finely around
        the best result.
        """
        if self.step < len(TURNS):
            shifts = _square(FARTHEST, PITCH)
            turn = TURNS[self.step]
        else:
            if self.step == len(TURNS):
                self.coarse = self.shift, self.turn
            middle, facing = self.coarse
            fine = PITCH / 4
            shifts = middle + _square(PITCH - fine, fine)
            turn = facing + FINE_TURNS[self.step - len(TURNS)]
        costs = self._costs(shifts, turn)
        best = int(costs.argmin())
        if float(costs[best]) < self.cost:
            self.cost = float(costs[best])
            self.shift = shifts[best].clone()
            self.turn = turn
        self.step += 1

    def _costs(self, shifts: Float[Tensor, "m 2"], turn: float) -> Float[Tensor, "m"]:
        """Return the negative log-probability of each translation [m] along the table, for one
        rotation [rad].
        """
        # [m, rad]
        shift_std = 0.03
        turn_std = 0.15
        cost = (shifts / shift_std).square().sum(-1) + (turn / turn_std) ** 2
        for age, touches in enumerate(
            self.touches
        ):  # a touch moves the object by twice the surface's deviation
            cost = cost + self._misfit(touches, shifts, turn) / (1 + 4 * age)
            if touches.nothing:
                cost = cost + 80 * torch.exp(
                    -2 * ((shifts - self.axes @ touches.palm) / shift_std).square().sum(-1)
                )
        return 0.5 * cost

    def _misfit(
        self, touches: Touches, shifts: Float[Tensor, "m 2"], turn: float
    ) -> Float[Tensor, "m"]:
        """Return how badly touches fit to each translation [m] along the table, for one rotation
        [rad].
        """
        # [m, 1]
        surface_std = 0.004
        normal_std = 0.3
        # least distance [m] of a tip in the air; bound on the cost of one tip
        gap = 0.001
        worst = 20.0
        felt = touches.felt
        (points, normals) = touches.means()
        rotation = rotation_from_vector(turn * self.up)
        there = torch.where(felt[:, None], points, touches.tips) - self.center
        before = (there - (shifts @ self.axes)[:, None]) @ rotation + self.center
        distance, gradient = self.surface.query(apply(self.obj_from_hand, before))
        outward = unit(gradient @ self.obj_from_hand[:3, :3] @ rotation.T)
        place = (distance / surface_std).square().clamp_max(2 * worst)
        facing = ((outward - normals) / normal_std).square().sum(-1)
        inside = (
            ((self.radius + gap - distance).clamp_min(0.0) / surface_std)
            .square()
            .clamp_max(2 * worst)
        )
        fit = torch.where(
            felt, place + facing, torch.where(touches.contact | ~touches.known, 0.0, inside)
        ).sum(-1)
        if len(touches.links):
            before = (
                touches.links[:, :3] - self.center - (shifts @ self.axes)[:, None]
            ) @ rotation + self.center
            off = self.surface.query(apply(self.obj_from_hand, before))[0] - touches.links[:, 3]
            fit = fit + (off.abs().amin(-1) / surface_std).square().clamp_max(2 * worst)
        return fit


def _square(half: float, pitch: float) -> Float[Tensor, "m 2"]:
    """Return the points of a square grid with spacing `pitch` from -half to half on both axes [m]."""
    line = torch.arange(-round(half / pitch), round(half / pitch) + 1, dtype=torch.float64) * pitch
    return torch.cartesian_prod(line, line)
