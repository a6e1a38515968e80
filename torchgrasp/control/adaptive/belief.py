"""Touches revise the shape: a surprising one moves the contacts of the fingers in the air.

Such a touch is an observation of the shape (`ShapeGP.update`). Each finger in the air then aims where the line through
its planned contact meets the revised surface. An update takes about 10 ms of one core, a tick at 100 Hz.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import settle
from torchgrasp.checks import checked
from torchgrasp.control.closing_law import position_gain, surface_covariance
from torchgrasp.control.forces import desired_forces
from torchgrasp.control.observation import Observation
from torchgrasp.control.reference import ClosingReference
from torchgrasp.control.tactile import FLAT_RADIUS, PLACE_NOISE
from torchgrasp.geometry.frames import apply, inverse, rotate
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import newton_step
from torchgrasp.values import ShapeEstimate

SURPRISE = 2.0
"""A touch surprises beyond so many standard deviations from the expected surface: 5 % do so by chance."""

FARTHEST = 0.02
"""Largest motion of a contact along its line [m]; one that meets no surface within it stays."""

NEWTON_STEPS, LEAST_SLOPE = 6, 0.3
"""Steps along a line to the surface, which converge quadratically; least cosine of line and normal, against grazing."""


class Belief:
    """A shape, the planned pose of the hand, and which fingers have touched.

    >>> from torchgrasp import ClosingReference, fit_shape, load_hand, load_object
    >>> from torchgrasp.control import no_contact, observe
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> grasp, hand = load_shipped_grasp("jug", "allegro"), load_hand("allegro")
    >>> reference, seen = ClosingReference.from_grasp(hand, grasp), observe(hand, grasp.joints[0], no_contact())
    >>> belief = Belief(fit_shape(load_object("jug").view), grasp.obj_from_hand[0])
    >>> belief.revise(seen, reference) is reference  # nothing was touched
    True
    """

    def __init__(self, shape: ShapeGP, obj_from_hand: Float[Tensor, "4 4"]) -> None:
        self.obj_from_hand = obj_from_hand.double()
        self.shape = settle(shape, obj_from_hand.device)
        self.hand_from_obj = inverse(self.obj_from_hand)
        self.touched: Tensor | None = None

    @checked
    def revise(self, observation: Observation, reference: ClosingReference) -> ClosingReference:
        """Return the reference, replanned for the fingers in the air after a surprising touch."""
        touched = torch.zeros_like(observation.tactile.contact) if self.touched is None else self.touched
        fresh = (
            observation.tactile.contact
            & ~touched
            & torch.isfinite(observation.tactile.points + observation.tactile.normals).all(-1)
        )
        if not bool(fresh.any()):
            return reference
        self.touched = touched | fresh
        points = apply(self.obj_from_hand, observation.tactile.points[fresh])
        inside = self.shape.contains(points)
        points, normals = points[inside], rotate(self.obj_from_hand, observation.tactile.normals[fresh])[inside]
        if not len(points):
            return reference
        along, expected = self._meet(points, normals)
        deviation = torch.hypot(expected.std_m, expected.std_m.new_tensor(PLACE_NOISE))
        surprising = along.abs() > (SURPRISE * deviation).clamp_max(0.99 * FARTHEST)
        if not bool(surprising.any()):
            return reference
        points, normals = points[surprising], normals[surprising]
        self.shape = self.shape.update(points, normals, noise=PLACE_NOISE, normal_noise=PLACE_NOISE / FLAT_RADIUS)
        return self._replan(~observation.tactile.contact, reference)

    def _replan(self, air: Bool[Tensor, "f"], reference: ClosingReference) -> ClosingReference:
        """Return the reference with the remaining contacts on the revised surface."""
        gains = reference.gains
        start, lines = apply(self.obj_from_hand, gains.target), rotate(self.obj_from_hand, reference.normals)
        along, surface = self._meet(start, lines)
        points = start + along[:, None] * lines
        moved = (air & (self._distance(points)[0].abs() <= PLACE_NOISE))[:, None]
        target = torch.where(moved, apply(self.hand_from_obj, points), gains.target)
        normals = torch.where(moved, rotate(self.hand_from_obj, surface.normal), reference.normals)
        covariance = torch.where(moved[..., None], surface_covariance(normals, surface.std_m), gains.covariance)
        strongest = float((-(gains.desired_force * reference.normals).sum(-1)).max())
        revised = dataclasses.replace(
            gains,
            target=target,
            covariance=covariance,
            position_gain=position_gain(covariance),
            desired_force=desired_forces(target, normals, strongest),
        )
        return dataclasses.replace(reference, normals=normals, gains=revised)

    def _meet(
        self, points: Float[Tensor, "n 3"], lines: Float[Tensor, "n 3"]
    ) -> tuple[Float[Tensor, "n"], ShapeEstimate]:
        """Return the distance [m] along lines to the surface, at most `FARTHEST`, and the estimate there."""
        along = torch.zeros_like(points[:, 0])
        for _ in range(NEWTON_STEPS):
            off, normal = self._distance(points + along[:, None] * lines)
            along = (along + newton_step(off, normal, lines, LEAST_SLOPE)).clamp(-FARTHEST, FARTHEST)
        return along, self.shape.predict(self.shape.metres(self._within(points + along[:, None] * lines)))

    def _distance(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Return first-order distance [m] from the surface and outward normal at points."""
        value, gradient = self.shape.mean_and_gradient(self._within(points))
        length = torch.linalg.vector_norm(gradient, dim=-1)
        return self.shape.scale * value / length, gradient / length[:, None]

    def _within(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Return normalised points, moved into the posterior's domain."""
        x = self.shape.normalise(points)
        far = torch.linalg.vector_norm(x, dim=-1, keepdim=True) / (0.999 * self.shape.domain_radius)
        return x / far.clamp_min(1.0)
