"""What decides whether a grasp holds its task: numbers that physics names, one column each, in SI units."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.frames import rotate
from torchgrasp.geometry.linalg import unit
from torchgrasp.hand.hand import Hand
from torchgrasp.plan.feasibility import normal_variation
from torchgrasp.plan.forces import least_friction_forces, tangential_ratio
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.success.loads import carrying_force, finger_levers, greatest_force, load_arm
from torchgrasp.success.task import GraspTask
from torchgrasp.values import Contacts, Grasps

CAUSES: dict[str, dict[str, str]] = {
    "load": {
        "force needed": "N", "force needed at half friction": "N", "force to spare": "1", "offset": "m",
        "offset across": "m", "arm": "1",
    },
    "friction": {
        "angle needed": "rad", "angle to spare": "rad", "angle to spare over tilt": "1", "normals apart": "1",
        "certificate margin": "1",
    },
    "surface": {"deviation": "m", "mean deviation": "m", "tilt": "rad"},
    "unseen": {"from seen": "m", "mean from seen": "m", "seen share": "1"},
    "bend": {"bend": "rad", "mean bend": "rad", "wide bend": "rad"},
    "place": {"height of lowest": "m", "below top": "m", "span": "m", "shortest side": "m", "steepest normal": "1"},
    "posture": {
        "lever": "m", "limit margin": "1", "greatest force": "N", "pad angle": "rad", "closing angle": "1",
        "clearance": "m", "approach up": "1",
    },
    "object": {"size": "m", "height": "m", "width": "m", "breadth": "m", "walls": "1"},
    "hand": {"fingers": "1", "tip radius": "m"},
    "task": {"friction": "1", "mass": "kg", "force": "N", "lifted": "1", "displaced": "1", "open loop": "1"},
}  # fmt: skip
"""The features with their units, by what they tell about."""

FEATURES = tuple(name for names in CAUSES.values() for name in names)
"""All features, in the order of the columns."""

GRIP = 15.0
"""Greatest force [N] that a hand which grips as the load asks for may need."""


def measure_grasps(
    hand: Hand,
    shape: ShapeGP,
    vertices: Float[Tensor, "v 3"],
    grasps: Grasps,
    friction: float,
    task: GraspTask,
    lifted: bool,
) -> Float[Tensor, "g k"]:
    """Return the `FEATURES` of each grasp for a task, at the friction coefficient `friction`.

    All positions are in an upright frame, whose z axis points up. `vertices` [m] are those of the estimated surface,
    whose mean is taken for the centre of mass. `lifted` tells whether the task is a lift or pulls.
    """
    within, radii = 0.006, (0.004, 0.008)  # [m]: distance of seen surface from the cloud; rings on which surface bends
    contacts, g = grasps.contacts, len(grasps)
    points, normals = contacts.points.to(shape.x), contacts.normals.to(shape.x)
    center, low, high = vertices.mean(0), vertices.amin(0), vertices.amax(0)
    forces = least_friction_forces(points, normals, strongest=1.0)
    needed = torch.atan(tangential_ratio(forces, normals).amax(-1)).nan_to_num(math.pi / 2)  # NaN: no balance
    spare, tilt = math.atan(friction) - needed, _normal_deviation(shape, points).amax(1)
    greatest = greatest_force(hand, grasps, forces).to(points).nan_to_num(0.0)
    carried, at_half = (_force_for(contacts, forces, center, f, task.mass, lifted) for f in (friction, 0.5 * friction))
    pressing = task.pressing(lifted)
    offset, std = points.mean(1) - center, contacts.require_std().to(points)
    gap = torch.cdist(points.flatten(0, 1), shape.cloud.points.to(points)).amin(1).view(points.shape[:2])
    seen = torch.cdist(vertices[:: len(vertices) // 1000 + 1], shape.cloud.points.to(points)).amin(1) < within
    x = shape.normalise(points)
    bend, wide = (normal_variation(shape, x, normals, radius) for radius in radii)
    sides = torch.linalg.vector_norm(points.roll(-1, 1) - points, dim=-1)
    spread = torch.linalg.svdvals(vertices[:, :2] - center[:2]) / math.sqrt(len(vertices))
    q, ways = grasps.joints.to(points), _closing_ways(hand, grasps).to(points)
    limits = torch.minimum(q - hand.lower.to(q), hand.upper.to(q) - q) / (hand.upper - hand.lower).to(q)
    found: dict[str, Tensor | float] = {
        "force needed": carried,
        "force needed at half friction": at_half,
        "force to spare": torch.minimum(greatest, greatest.new_tensor(pressing or GRIP)) / at_half,
        "offset": torch.linalg.vector_norm(offset, dim=-1),
        "offset across": torch.linalg.vector_norm(offset[:, :2], dim=-1),
        "arm": load_arm(points, center),
        "angle needed": needed,
        "angle to spare": spare,
        "angle to spare over tilt": spare / tilt.clamp_min(1e-3),
        "normals apart": torch.linalg.vector_norm(normals.mean(1), dim=-1),
        "certificate margin": grasps.certificate.margin,
        "deviation": std.amax(1),
        "mean deviation": std.mean(1),
        "tilt": tilt,
        "from seen": gap.amax(1),
        "mean from seen": gap.mean(1),
        "seen share": float(seen.double().mean()),
        "bend": bend.amax(1),
        "mean bend": bend.mean(1),
        "wide bend": wide.amax(1),
        "height of lowest": points[..., 2].amin(1) - low[2],
        "below top": high[2] - points[..., 2].amax(1),
        "span": sides.amax(1),
        "shortest side": sides.amin(1),
        "steepest normal": normals[..., 2].abs().amax(1),
        "lever": finger_levers(hand, grasps).amin(1),
        "limit margin": limits.amin(1),
        "greatest force": greatest,
        "pad angle": grasps.normal_angle.amax(1),
        "closing angle": -(ways * normals).sum(-1).amax(1),
        "clearance": grasps.clearance,
        "approach up": grasps.approach[:, 2],
        "size": shape.scale,
        "height": float(high[2] - low[2]),
        "width": float(spread[0]),
        "breadth": float(spread[1]),
        "walls": float(len(shape.walls)),
        "fingers": float(points.shape[1]),
        "tip radius": float(hand.tips.radius.mean()),
        "friction": friction,
        "mass": task.mass,
        "force": pressing,
        "lifted": float(lifted),
        "displaced": float(task.displaced),
        "open loop": float(task.closing == "open_loop"),
    }
    assert tuple(found) == FEATURES
    columns = [x.to(points) if isinstance(x, Tensor) else points.new_full((g,), x) for x in found.values()]
    return torch.stack(columns, -1)


def _force_for(
    contacts: Contacts, forces: Float[Tensor, "g f 3"], center: Float[Tensor, "3"], friction: float, mass: float,
    lifted: bool,
) -> Float[Tensor, "g"]:  # fmt: skip
    """Return the force [N] of the strongest finger with which no contact slides under the task's load."""
    weight, pull = (9.81 * mass, 0.0) if lifted else (0.0, 10.0 * mass)
    load = center.new_tensor([0.0, 0.0, -weight])
    return carrying_force(contacts, forces, center, friction, load, pull).clamp(1e-3, 1e3)  # infinite: no force does


def _normal_deviation(shape: ShapeGP, points: Float[Tensor, "g f 3"]) -> Float[Tensor, "g f"]:
    """Return the standard deviation [rad] of the surface's normal at each contact, about the axis of largest one."""
    mean, spread = shape.estimate(shape.normalise(points).flatten(0, 1))
    normal, slope = unit(mean[:, 1:]), torch.linalg.vector_norm(mean[:, 1:], dim=-1)
    across = torch.eye(3).to(normal) - normal[:, :, None] * normal[:, None]
    largest = torch.linalg.eigvalsh(across @ spread[:, 1:, 1:] @ across)[:, -1].clamp_min(0).sqrt()
    return (shape.std_factor * largest / slope).view(points.shape[:2])


def _closing_ways(hand: Hand, grasps: Grasps) -> Float[Tensor, "g f 3"]:
    """Return the unit direction in which each fingertip closes, in the object's frame; zeros if it stays."""
    before, after = (hand.tip_centres(joints) for joints in (grasps.pregrasp, grasps.joints))
    path = rotate(grasps.obj_from_hand.to(after), after - before)
    return path / torch.linalg.vector_norm(path, dim=-1, keepdim=True).clamp_min(1e-6)  # [m]
