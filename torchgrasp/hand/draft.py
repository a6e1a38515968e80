"""A first hand.toml for a URDF: fingers, pads, coupling, pairs of links.

A URDF does not say where a finger's pad is. Here the pad faces where the finger's last joint bends. A joint bends to
the side with most of its range; if both have as much, towards the other fingertips.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.frames import rigid, rotation_from_rpy
from torchgrasp.hand.collision_pairs import collision_pairs, draw_postures
from torchgrasp.hand.hand_toml import Pad
from torchgrasp.hand.kinematics import map_points, tree_from_urdf
from torchgrasp.hand.urdf import Joint, Shape, Triple, Urdf, read_urdf

DRAFT_POSTURES = 20_000
"""Random postures from which pads and approach are guessed."""
MEETING_SHARE = 0.1
"""Share of the postures that tells where the fingers meet: those with the nearest fingertips."""
ONE_SIDED = 0.1
"""A joint bends to one side if the middle of its range is farther off zero than this, over the range's length."""
TILT = math.radians(30)
"""A round tip touches this far from its direction of motion, towards its end: so the Allegro hand closes most often."""
SHORT_ARM = 1e-3
"""A joint whose axis passes a tip nearer than this [m] does not move it."""
STIFFNESS, DAMPING = 4.0, 0.03
"""Drive [rad^-1] per N m of the weakest joint's effort, and its damping [s]: about those of the shipped hands."""

Vector = Float[np.ndarray, "3"]


def draft_hand(path: Path | str, tips: Sequence[str] = (), name: str | None = None, seed: int = 0) -> str:
    """Write the text of a hand.toml for a URDF, to be looked over and checked by `check_hand`.

    Args:
        path: of the URDF.
        tips: links of the three grasping fingertips in grasp order, then of the fingers to park; by default the ends of
            the tree's branches, which must be three.
        name: of the hand; by default the robot's.
        seed: of the random postures.

    Raises:
        HandFileError: the URDF is missing or malformed.
        BadArgument: fewer than three tips, or one without a collision shape or a joint that moves it.

    >>> from torchgrasp.hand.load import find_hand
    >>> text = draft_hand(find_hand("barrett") / "hand.urdf")
    >>> '"f1_distal" = { source = "f1_flex"' in text
    True
    """
    urdf = read_urdf(path)
    ends = fingertip_links(urdf)
    chosen = tuple(tips) or ends
    if len(chosen) < 3 or (not tips and len(chosen) > 3) or len(set(chosen)) < len(chosen):
        wanted = f"three links in grasp order, then those to park; the branches of {urdf.path} end in {list(ends)}"
        raise BadArgument("tips", list(tips) or "none", wanted)
    chains = {tip: tuple(j.name for j in urdf.movers(tip)[::-1]) for tip in chosen}
    shaped = {x.name for x in urdf.links if x.shapes}
    for tip in chosen:
        if tip not in shaped or not chains[tip]:
            raise BadArgument("tips", tip, f"links with a collision shape that joints move, as {list(ends)}")
    coupling = {j.name: j.mimic for j in urdf.movable if j.mimic is not None}
    free = [j for j in urdf.movable if j.name not in coupling]
    grasping = {joint for tip in chosen[:3] for joint in chains[tip]}
    moved = grasping | {coupling[j].source for j in grasping if j in coupling}
    parked = {j.name: min(max(0.0, j.lower), j.upper) for j in free if j.name not in moved}
    frames = tree_from_urdf(urdf).frames(draw_postures(urdf, coupling, DRAFT_POSTURES, seed))
    pads, approach = guess_pads(urdf, frames, chosen)
    kp = STIFFNESS * min((j.effort for j in free if j.effort > 0), default=1.0)
    names = {tip: tip.removesuffix("_tip") for tip in chosen}
    lines = [
        "# A draft. Lengths [m], angles [rad], in the link frames of the URDF. Look over what is marked CHECK.",
        f"name = {_toml(name or urdf.name or 'hand')}",
        f"urdf = {_toml(urdf.path.name)}",
        f"base_link = {_toml(urdf.root)}",
        f"approach = {_toml(approach)}  # CHECK: out of the palm",
        "limit_margin = 0.0  # taken off both ends of every joint's range",
        "",
        "[actuators]  # joint position control; effort [N m] and velocity [rad/s] are those of the URDF",
        f"kp = {kp:.3g}  # CHECK: [N m/rad]",
        f"kd = {DAMPING * kp:.3g}  # [N m s/rad]",
    ]
    if coupling:
        lines += ["", "# joint = ratio * source + offset", "[coupling]"]
    for joint, (source, ratio, offset) in coupling.items():
        lines.append(f"{_toml(joint)} = {{ source = {_toml(source)}, ratio = {ratio!r}, offset = {offset!r} }}")
    lines += ["", "# Which fingers grasp, in grasp order; every other joint is parked.", "[options.default]"]
    lines.append(f"fingers = {_toml([names[tip] for tip in chosen[:3]])}")
    if parked:
        row = ", ".join(f"{_toml(joint)} = {value!r}" for joint, value in parked.items())
        lines.append(f"parked = {{ {row} }}  # CHECK: out of the way of the others")
    for tip, pad in zip(chosen, pads, strict=True):
        lines += ["", "[[finger]]", f"name = {_toml(names[tip])}"]
        lines += [f"joints = {_toml(chains[tip])}", f"tip_link = {_toml(tip)}"]
        lines += [f"contact = {_toml(pad.contact)}  # CHECK: the middle of the pad", f"normal = {_toml(pad.normal)}"]
        sphere = ['tip = "sphere"', f"center = {_toml(pad.center)}", f"radius = {pad.radius!r}"]
        lines += sphere if pad.radius else ['tip = "point"']
    lines += ["", "[self_collision]", "# The pairs of links that meet in some random postures, but not in nearly all."]
    lines += ["pairs = [", *(f"  {_toml(pair)}," for pair in collision_pairs(urdf, coupling, seed=seed)), "]", ""]
    return "\n".join(lines)


def fingertip_links(urdf: Urdf) -> tuple[str, ...]:
    """Return every movable branch's last link with a collision shape."""
    parents, shaped = {j.parent for j in urdf.joints}, {x.name for x in urdf.links if x.shapes}
    ends = []
    for link in (x.name for x in urdf.links if x.name not in parents):
        ends += [x for x in (link, *(j.parent for j in urdf.joints_above(link))) if x in shaped][:1]
    return tuple(e for e in dict.fromkeys(ends) if urdf.movers(e))


def guess_pads(urdf: Urdf, frames: Float[Tensor, "3 4 l n"], tips: Sequence[str]) -> tuple[tuple[Pad, ...], Triple]:
    """Guess the pads of the tips and the direction out of the palm, from the links' frames in random postures."""
    links = {x.name: i for i, x in enumerate(urdf.links)}
    index = torch.tensor([links[tip] for tip in tips])
    # a tip's shape is the one that reaches farthest from its joint
    shapes = [max(urdf.links[i].shapes, key=lambda s: math.dist(s.xyz, (0.0, 0.0, 0.0))) for i in index.tolist()]
    cores = [_core(shape) for shape in shapes]
    tip_frames = frames.index_select(2, index)
    centres = map_points(tip_frames, torch.tensor(np.stack(cores)))  # 3 f n
    middle = centres[:, :3].mean(1, keepdim=True)
    spread = torch.linalg.vector_norm(centres[:, :3] - middle, dim=0).sum(0)
    near = spread.topk(max(1, int(MEETING_SHARE * len(spread))), largest=False).indices
    inward = (tip_frames[:, :3] * (middle - centres)[:, None])[..., near].sum(0).mean(-1).T.numpy()  # tips' frames
    pads = []
    for tip, shape, core, closing in zip(tips, shapes, cores, inward, strict=True):
        joint, motion, outward = _motion(urdf, tip, core)
        middle_of_range = (joint.lower + joint.upper) / 2
        one_sided = abs(middle_of_range) > ONE_SIDED * (joint.upper - joint.lower)
        bending = math.copysign(1.0, middle_of_range if one_sided else motion @ closing)
        pads.append(_pad(shape, core, bending * motion, outward))
    palm = next(x for x in urdf.links if x.name == urdf.root)
    palm_centre = np.mean([s.xyz for s in palm.shapes], axis=0) if palm.shapes else np.zeros(3)
    out = middle[:, 0, near].mean(1).numpy() - palm_centre
    axis = int(np.abs(out).argmax())
    return tuple(pads), _triple(np.sign(out[axis]) * np.eye(3)[axis])


def _motion(urdf: Urdf, tip: str, core: Vector) -> tuple[Joint, Vector, Vector]:
    """Return the last joint that moves a tip, and the directions of motion and of the arm in the tip's frame."""
    tip_from_above = np.eye(4)
    for joint in urdf.joints_above(tip):
        if joint.kind != "fixed":
            axis, arm = tip_from_above[:3, :3] @ np.array(joint.axis), core - tip_from_above[:3, 3]
            motion = axis if joint.kind == "prismatic" else np.cross(axis, arm)
            length = float(np.linalg.norm(motion))
            if length > SHORT_ARM:
                arm = arm - (arm @ axis) * axis
                return joint, motion / length, arm / max(float(np.linalg.norm(arm)), SHORT_ARM)
        above_from_link = rigid(rotation_from_rpy(joint.rpy), torch.tensor(joint.xyz, dtype=torch.float64))
        tip_from_above = tip_from_above @ np.linalg.inv(above_from_link.numpy())
    raise BadArgument("tips", tip, "links that a joint moves")


def _half(shape: Shape) -> Vector:
    """Return the half sizes of a shape's bounding box."""
    if shape.kind == "box":
        return np.array(shape.size) / 2
    radius = shape.size[0]
    return np.array([radius, radius, radius if shape.kind == "sphere" else shape.size[1] / 2])


def _core(shape: Shape) -> Vector:
    """Return the point one half thickness before the far end of a tip, in the link's frame."""
    center, half = np.array(shape.xyz), _half(shape)
    rotation, long = rotation_from_rpy(shape.rpy).numpy(), int(half.argmax())
    inset = half[long] - np.delete(half, long).min()
    return center + math.copysign(inset, rotation[:, long] @ center) * rotation[:, long]


def _pad(shape: Shape, core: Vector, motion: Vector, outward: Vector) -> Pad:
    """Return the pad of a tip that moves along `motion`; on a sphere it is tilted outward."""
    if shape.kind == "sphere":
        normal, radius = math.cos(TILT) * motion + math.sin(TILT) * outward, shape.size[0]
        center, normal = np.array(shape.xyz), normal / np.linalg.norm(normal)
        return Pad(_triple(center + radius * normal), _triple(normal), _triple(center), radius)
    rotation, half = rotation_from_rpy(shape.rpy).numpy(), _half(shape)
    side = rotation.T @ motion
    side[int(half.argmax())] = 0.0  # along the tip's length there is no pad
    if shape.kind == "box":
        face = int(np.abs(side).argmax())
        side, depth = np.sign(side[face]) * np.eye(3)[face], half[face]
    else:
        side, depth = side / np.linalg.norm(side), shape.size[0]
    contact = core + depth * (rotation @ side)
    return Pad(_triple(contact), _triple(rotation @ side), _triple(contact), 0.0)


def _triple(x: Vector) -> Triple:
    """Return an array as three numbers that print shortly."""
    a, b, c = (round(float(v), 12) + 0.0 for v in x)
    return a, b, c


def _toml(x: object) -> str:
    return json.dumps(x, ensure_ascii=False)
