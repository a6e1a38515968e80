"""A peer in the manner of FRoGGeR: one start at a time, refined by SciPy's SLSQP on pose, joints and contacts.

The least weight of a balance of the contacts' wrenches, the min-weight metric, is maximised until all constraints hold:
fingertips on the surface within their pads' cones, no link inside the object, the table or another link, a least
weight. Geometry and derivatives are torchgrasp's, the weight and its derivative those of a linear programme [1].

[1] Li, Culbertson, Burdick and Ames, "FRoGGeR: Fast Robust Grasp Generation via the Min-Weight Metric", IROS 2023.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import linprog, minimize
from torch import Tensor

from torchgrasp import Contacts, ContactSpec, Hand, ShapeGP
from torchgrasp.geometry.frames import rotation_from_vector, skew
from torchgrasp.ik.clearance import CollisionWorld, along
from torchgrasp.ik.configuration import Configuration, SpatialJacobian
from torchgrasp.plan.problem import triple_mean_jet
from torchgrasp.plan.wrench import wrenches

CUT_OFF = 0.05
"""Least weight over that of equal ones. FRoGGeR's 0.3 is more than most executable grasps of three fingers have."""
GAP = 1e-3
"""Clearance [m] asked of links."""
STEPS, PRECISION = 200, 1e-4
"""Most iterations of SLSQP, and the change of the metric at which it ends."""
UNIT = 1e-2
"""Unit of lengths [m], in which unknowns and constraints are of order one."""
ON, INSIDE = 0.01, 1e-3
"""How far off [`UNIT`] a tip may be from its contact, 0.1 mm, and an inequality from its bound."""


class Values(NamedTuple):
    """The cost, equations, and inequalities (>= 0) of unknowns, each with its derivative."""

    cost: float
    by_cost: np.ndarray
    off: np.ndarray
    by_off: np.ndarray
    room: np.ndarray
    by_room: np.ndarray

    @property
    def feasible(self) -> bool:
        """Tell whether all constraints hold."""
        return bool(np.abs(self.off).max() < ON and self.room.min() > -INSIDE)


class _Found(Exception):
    """Ends a search where all constraints hold."""


@dataclasses.dataclass(frozen=True)
class SingleStart:
    """A search from one configuration and contacts [m]: a hand, a surface, and what links must not run into.

    Unknowns are a translation [`UNIT`] and a rotation vector of the hand, its joints, and the normalised contacts.
    """

    hand: Hand
    shape: ShapeGP
    world: CollisionWorld
    spec: ContactSpec
    begin: Configuration
    points: Float[Tensor, "1 f 3"]

    def search(self) -> tuple[Configuration, Contacts] | None:
        """Return the first grasp for which all constraints hold; None: SLSQP ends at no such."""
        known: dict[bytes, Values] = {}

        def at(x: np.ndarray) -> Values:
            key = x.tobytes()
            if key not in known:
                known.clear()
                known[key] = self.evaluate(x)
                if known[key].feasible:
                    raise _Found(x.copy())
            return known[key]

        lower, upper = self.hand.lower.numpy(), self.hand.upper.numpy()
        contacts = self.shape.normalise(self.points).flatten().numpy()
        free = [(None, None)]
        try:
            minimize(
                lambda x: at(x).cost,
                np.concatenate([np.zeros(6), self.begin.joints[0].numpy(), contacts]),
                jac=lambda x: at(x).by_cost,
                method="SLSQP",
                bounds=6 * free + list(zip(lower, upper, strict=True)) + len(contacts) * free,
                constraints=[
                    {"type": "eq", "fun": lambda x: at(x).off, "jac": lambda x: at(x).by_off},
                    {"type": "ineq", "fun": lambda x: at(x).room, "jac": lambda x: at(x).by_room},
                ],
                options={"maxiter": STEPS, "ftol": PRECISION},
            )
        except _Found as found:
            x = found.args[0]
            return self.configuration(x), self.contacts(x)
        return None

    def configuration(self, x: np.ndarray) -> Configuration:
        """Return the configuration of unknowns, its joints within the limits: SLSQP keeps them but for rounding."""
        step = np.concatenate([UNIT * x[:3], x[3:6], x[6 : 6 + self.hand.dof] - self.begin.joints[0].numpy()])
        return self.begin.integrate(self.hand, torch.from_numpy(step)[None])

    def contacts(self, x: np.ndarray) -> Contacts:
        """Return the contacts [m] of unknowns."""
        points = self.shape.metres(torch.from_numpy(x[6 + self.hand.dof :]).reshape(1, -1, 3))
        estimate = self.shape.predict(points)
        return Contacts(points, estimate.normal, estimate.variance, estimate.std_m)

    def evaluate(self, x: np.ndarray) -> Values:
        """Return cost and constraints with their derivatives."""
        hand, scale, f, free = self.hand, float(self.shape.scale), len(self.hand.tips), 6 + self.hand.dof
        spatial, by_hand = SpatialJacobian.at(hand, self.configuration(x)), self._steps_by_unknowns(x)
        at = torch.from_numpy(x[free:]).reshape(1, f, 3)
        points, jet = self.shape.metres(at), triple_mean_jet(self.shape, at)
        normals, own = jet.normals, torch.eye(3 * f, dtype=at.dtype).unflatten(0, (f, 3))
        turned = jet.normal_jacobian[0] @ own  # (f, 3, 3 f): the normals by all contacts

        def rows(by_configuration: Tensor, by_contacts: Tensor) -> np.ndarray:
            return torch.cat([by_configuration[:, :free] @ by_hand, by_contacts], 1).numpy()

        finger, radius = torch.arange(f).repeat_interleave(3), hand.tips.radius[:, None]
        centre, pads, moves = spatial.tips.permute(2, 1, 0), spatial.pads.permute(2, 1, 0), hand.motion.moves.to(at)
        along_axes = _wrenches(centre[:, finger], torch.eye(3, dtype=at.dtype).repeat(f, 1)[None])
        moved = spatial.jacobian(along_axes, moves[hand.tips.index[finger]])[0]
        off = torch.cat([scale * jet.distance, (centre - points - radius * normals).flatten(1)], 1)[0]
        off_by_contacts = torch.cat([
            scale * (jet.gradient[0, :, None] @ own)[:, 0],
            -(scale * own + radius[..., None] * turned).flatten(0, 1),
        ])  # fmt: skip
        by_off = rows(torch.cat([moved.new_zeros(f, free), moved]), off_by_contacts) / UNIT

        cost, by_point, by_normal = differentiate(partial(least_weight, self.spec), points, normals)
        cost_by_contacts = scale * by_point.reshape(1, -1) + (by_normal[0, :, None] @ turned).sum(0)
        by_cost = rows(moved.new_zeros(1, free), cost_by_contacts)
        facing = -(pads * normals).sum(-1)[0] - hand.tips.cone.cos()
        torque = torch.cat([torch.zeros_like(pads), torch.linalg.cross(pads, normals)], -1)
        facing_by_hand = -spatial.jacobian(torque, moves[hand.tips.index])[0]
        by_facing = rows(facing_by_hand, -(pads[0, :, None] @ turned)[:, 0])
        clear, clear_by_hand = clearances(spatial, self.world)
        by_clear = rows(clear_by_hand, clear.new_zeros(len(clear), 3 * f)) / UNIT
        room = torch.cat([-cost - CUT_OFF, facing, (clear - GAP) / UNIT]).numpy()
        return Values(
            float(cost), by_cost[0], off.numpy() / UNIT, by_off, room, np.concatenate([-by_cost, by_facing, by_clear])
        )

    def _steps_by_unknowns(self, x: np.ndarray) -> Float[Tensor, "d d"]:
        """Return the derivative of steps in the hand's present axes by its unknowns."""
        steps, vector = torch.eye(6 + self.hand.dof, dtype=torch.float64), torch.from_numpy(x[3:6].copy())
        angle, cross = float(torch.linalg.vector_norm(vector)), skew(vector)
        first, second = 0.5, 1 / 6
        if angle > 1e-3:
            first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
        steps[:3, :3] = UNIT * rotation_from_vector(vector[None])[0].T
        steps[3:6, 3:6] = torch.eye(3, dtype=torch.float64) - first * cross + second * cross @ cross
        return steps


def least_weight(spec: ContactSpec, points: Tensor, normals: Tensor) -> Tensor:
    """Return minus the least weight of the best balance over that of equal weights, by HiGHS."""
    wrench = wrenches(points, normals, spec.planned_friction, spec.edges).flatten(1, 2)[0]
    fixed, m = wrench.detach().numpy(), len(wrench)
    # max s: W (s + psi) = 0, sum(s + psi) = 1, psi >= 0
    equations = np.vstack([np.hstack([fixed.T, fixed.sum(0)[:, None]]), np.r_[np.ones(m), m]])
    bounds = [(0, None)] * m + [(None, None)]
    answer = linprog(np.r_[np.zeros(m), -1.0], A_eq=equations, b_eq=np.eye(7)[6], bounds=bounds, method="highs")
    weights, dual = torch.from_numpy(answer.x[:m] + answer.x[m]), torch.from_numpy(answer.eqlin.marginals[:6])
    change = weights @ (wrench - wrench.detach())  # the optimum moves by -dual . (dW weights)
    return m * (answer.fun - change @ dual)[None]


def differentiate(cost: Callable[[Tensor, Tensor], Tensor], points: Tensor, normals: Tensor) -> tuple[Tensor, ...]:
    """Return a cost and its gradients by points and normals."""
    with torch.enable_grad():
        leaves = points.detach().requires_grad_(), normals.detach().requires_grad_()
        value = cost(*leaves)
        return value.detach(), *torch.autograd.grad(value.sum(), leaves)


def clearances(spatial: SpatialJacobian, world: CollisionWorld) -> tuple[Float[Tensor, "k"], Float[Tensor, "k d"]]:
    """Return the least clearances [m] of links from object and table, and of pairs of links, by steps of one hand."""
    spheres, pairs = spatial.hand.collision_spheres, spatial.hand.self_collision
    centres, moves = spatial.sphere_centres, spatial.hand.motion.moves.to(spatial.spheres)
    assert world.field is not None and world.plane is not None
    distance, gradient = world.field.query(centres)
    height, up = along(centres, world.plane) - world.plane.offset, world.plane.normal.expand_as(gradient)
    values, jacobians = [], []
    for clear, direction, which in (
        (distance - spheres.radius, gradient, ~spheres.touching),
        (height - spheres.radius, up, torch.ones_like(spheres.touching)),
    ):
        near = _least_of_each(clear[0], spheres.link_index, which)
        values.append(clear[0, near])
        wrench = _wrenches(centres[:, near], direction[:, near])
        jacobians.append(spatial.jacobian(wrench, moves[spheres.link_index[near]])[0])
    pushes, number, wrench = pairs.pushes(spatial.obj_from_link, torch.inf)
    separation, links = pushes[:, 0], pairs.link[pairs.pairs]
    names = links.amin(1) * len(spatial.hand.tree.link_names) + links.amax(1)
    near = _least_of_each(separation, names, torch.ones_like(names, dtype=torch.bool))
    first, second = moves[links[near]].unbind(1)
    values.append(separation[near])
    jacobians.append(spatial.jacobian(wrench.T[number[near, 0]][None], second - first)[0])
    return torch.cat(values), torch.cat(jacobians)


def _wrenches(points: Float[Tensor, "1 k 3"], directions: Float[Tensor, "1 k 3"]) -> Float[Tensor, "1 k 6"]:
    """Return the wrenches of unit forces along directions at points."""
    return torch.cat([directions, torch.linalg.cross(points, directions)], -1)


def _least_of_each(values: Tensor, group: Tensor, which: Tensor) -> Tensor:
    """Return the index of the least value of each group, of those asked for."""
    order = torch.nonzero(which)[:, 0]
    order = order[values[order].argsort(stable=True)]
    order = order[group[order].argsort(stable=True)]
    first = torch.ones_like(order, dtype=torch.bool)
    first[1:] = group[order][1:] != group[order][:-1]
    return order[first]
