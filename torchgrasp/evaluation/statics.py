"""Static analysis: the least forces with which a hand's drives could hold an object, if it knew mass and friction."""

import math
from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import Count, Positive, Range, checked
from torchgrasp.closure import ClosureResult
from torchgrasp.control.holding.least_forces import grasp_map
from torchgrasp.control.observation import joint_jacobian
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse
from torchgrasp.hand.hand import Hand

if TYPE_CHECKING:
    import trimesh

EDGES = 16
"""Edges of a friction cone, inside the round one: 2 % of the friction is given away at most."""

GRAVITY = 9.81
"""[m/s^2]."""


@checked
def least_grip(
    points: Float[Tensor, "f 3"],
    normals: Float[Tensor, "f 3"],
    load: Float[Tensor, "6"],
    friction: Annotated[float, Range(0.0, 10.0)],
    torques: Float[Tensor, "f j 3"] | None = None,
) -> Float[Tensor, "f 3"] | None:
    """Return the forces of the least normal sum that carry a load, or None where there are none.

    Args:
        points: contacts [m].
        normals: outward unit normals.
        load: force [N] and torque about the mean of the contacts [N m] that the forces have to sum to.
        friction: at every contact.
        torques: joint torques over their largest by a force of 1 N along each axis; None: without limit.

    >>> points = torch.tensor([[0.0, 1, 0], [0, -1, 0]])
    >>> forces = least_grip(points, points, torch.tensor([1.0, 0, 0, 0, 0, 0]), friction=0.5)
    >>> forces[:, 1].tolist()
    [-1.0, 1.0]
    """
    from scipy.optimize import linprog

    p, n, f = points.double().numpy(), normals.double().numpy(), len(points)
    side = np.cross(n, np.eye(3)[np.abs(n).argmin(1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = 2 * math.pi * np.arange(EDGES) / EDGES
    around = np.cos(angle)[:, None] * side[:, None] + np.sin(angle)[:, None] * np.cross(n, side)[:, None]
    edges = friction * around - n[:, None]  # (f, e, 3), each pushes with 1 N
    columns = np.zeros((3 * f, f * EDGES))
    for i in range(f):
        columns[3 * i : 3 * i + 3, i * EDGES : (i + 1) * EDGES] = edges[i].T
    size = np.repeat([1.0, 1 / max(float(np.ptp(p, axis=0).max()), 1e-6)], 3)  # forces and torques alike
    limits = {}
    if torques is not None:
        share = np.concatenate(list(torques.double().numpy()), axis=1) @ columns
        limits = {"A_ub": np.concatenate([share, -share]), "b_ub": np.ones(2 * len(share))}
    balance, wanted = size[:, None] * (grasp_map(p) @ columns), size * load.double().numpy()
    found = linprog(np.ones(f * EDGES), A_eq=balance, b_eq=wanted, **limits)
    return torch.from_numpy((columns @ found.x).reshape(f, 3)) if found.status == 0 else None


@checked
def least_grip_at(
    closure: ClosureResult, tick: Count, hand: Hand, mesh: "trimesh.Trimesh", mass: Positive, friction: Positive
) -> tuple[float | None, float]:
    """Return the least normal sum [N] that could hold the object at a tick of a trial, and the sum there was.

    The contacts are the true ones. None: the drives cannot hold it, or fewer than two fingers touch.

    Args:
        closure: the trial, of an object on a level table.
        tick: row of its columns.
        hand: that closed.
        mesh: of the object [m].
        mass: of the object [kg].
        friction: of every contact.

    Raises:
        BadArgument: a tick that the trial has not.
    """
    if tick >= len(closure.time):
        raise BadArgument("tick", tick, f"less than the {len(closure.time)} of the trial")
    hand, trace = hand.to("cpu", torch.float64), closure.trace
    touching = torch.isfinite(trace.points[tick]).all(-1)
    spent = float(-(trace.forces[tick] * trace.normals[tick])[touching].sum())
    if int(touching.sum()) < 2:
        return None, spent
    hand_from_object = inverse(closure.hand_pose[tick]) @ closure.object_pose[tick]
    centre = apply(hand_from_object, torch.from_numpy(np.array(mesh.center_mass, dtype=np.float64))[None])[0]
    places = [closure.joint_names.index(name) for name in hand.tree.joint_names]
    points = torch.where(touching[:, None], trace.points[tick], 0.0)
    jacobian = joint_jacobian(hand, closure.joints[tick][places], points)[touching]
    effort = torch.tensor([hand.actuators[name].effort for name in hand.tree.joint_names], dtype=torch.float64)
    up = closure.hand_pose[tick][:3, :3].T @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    force = mass * GRAVITY * up
    points, normals = points[touching], trace.normals[tick][touching]
    load = torch.cat([force, torch.linalg.cross(centre - points.mean(0), force)])
    forces = least_grip(points, normals, load, friction, jacobian.mT / effort[:, None])
    return (None if forces is None else float(-(forces * normals).sum())), spent
