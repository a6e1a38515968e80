"""A first hand.toml for a URDF: fingers, pads, coupling and pairs of links as far as the tree and its shapes tell.

Where a finger's pad is no URDF says. Here it faces the way in which its last joint bends it, which is where that joint
has most of its range; a joint with as much range on both sides is taken to bend to the middle of the three fingertips.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.frames import rotation_from_rpy
from torchgrasp.hand.collision_pairs import collision_pairs, draw_postures
from torchgrasp.hand.kinematics import map_points, tree_from_urdf
from torchgrasp.hand.urdf import Joint, Link, Shape, Triple, Urdf, read_urdf

POSTURES = 20_000
"""Random postures by which pads and approach are guessed."""
NEAR = 0.1
"""Share of the postures, those of the fingertips nearest to each other, that tell where the fingers meet."""
ONE_SIDED = 0.1
"""A joint's range that is farther off zero than this, over its length, tells which way the joint bends."""
TILT = math.radians(30)
"""A round tip touches this far from the way it moves, towards its end: so the Allegro hand closes most often."""
SHORT = 1e-3
"""A joint whose axis passes a tip nearer than this [m] turns it on the spot."""
STIFFNESS, DAMPING = 4.0, 0.03
"""Drive [N m/rad] for each N m of the weakest joint's effort, and its damping [N m s/rad] for each N m/rad: about
those of the shipped hands."""


@dataclasses.dataclass(frozen=True)
class Pad:
    """Where a fingertip touches, in its link's frame [m]; the radius of a round tip's sphere about `center`, else 0."""

    contact: Triple
    normal: Triple
    center: Triple
    radius: float


def draft_hand(path: Path | str, tips: Sequence[str] = (), name: str | None = None, seed: int = 0) -> str:
    """Write the text of a hand.toml for a URDF, to be looked over, saved beside it and checked by `check_hand`.

    Args:
        path: of the URDF.
        tips: the links of the three grasping fingertips in grasp order, then those of the fingers to park; by default
            the ends of the tree's branches, which must be three.
        name: of the hand; by default the robot's.
        seed: of the random postures.

    Raises:
        HandFileError: the URDF is missing or malformed.
        BadArgument: `tips` are not three or more links that have collision shapes and that joints move; without
            `tips`, the branches are not three. The message lists the ends of the branches.

    >>> from torchgrasp.hand.load import find_hand
    >>> text = draft_hand(find_hand("barrett") / "hand.urdf")
    >>> '"f1_distal" = { source = "f1_flex"' in text
    True
    """
    urdf = read_urdf(path)
    found = fingertip_links(urdf)
    chosen = tuple(tips) or found
    if len(chosen) < 3 or (not tips and len(chosen) > 3) or len(set(chosen)) < len(chosen):
        wanted = f"three links in grasp order, then those to park; the branches of {urdf.path} end in {list(found)}"
        raise BadArgument("tips", list(tips) or "none", wanted)
    chains = {tip: _chain(urdf, tip, found) for tip in chosen}
    coupling = {j.name: j.mimic for j in urdf.joints if j.mimic is not None}
    kinds = {j.name: j for j in urdf.joints if j.kind != "fixed"}
    grasping = {joint for tip in chosen[:3] for joint in chains[tip]}
    moved = grasping | {coupling[j][0] for j in grasping if j in coupling}
    parked = {j: min(max(0.0, k.lower), k.upper) for j, k in kinds.items() if j not in moved and j not in coupling}
    frames = tree_from_urdf(urdf).frames(draw_postures(urdf, coupling, POSTURES, seed))
    pads, approach = guess_pads(urdf, frames, chosen)
    efforts = [k.effort for j, k in kinds.items() if j not in coupling and k.effort > 0]
    kp = STIFFNESS * min(efforts, default=1.0)
    pairs = collision_pairs(urdf, coupling, seed=seed)

    names = {tip: tip.removesuffix("_tip") for tip in chosen}
    lines = [
        "# A draft. Lengths [m], angles [rad], in the link frames of the URDF. Look over what is marked CHECK.",
        f"name = {_text(name or urdf.name or 'hand')}",
        f"urdf = {_text(urdf.path.name)}",
        f"base_link = {_text(urdf.root)}",
        f"approach = {_list(approach)}  # CHECK: out of the palm",
        "limit_margin = 0.0  # taken off both ends of every joint's range",
        "",
        "[actuators]  # joint position control; effort [N m] and velocity [rad/s] are those of the URDF",
        f"kp = {kp:.3g}  # CHECK: [N m/rad]",
        f"kd = {DAMPING * kp:.3g}  # [N m s/rad]",
        *_coupling_lines(coupling),
        "",
        "# Which fingers grasp, in grasp order; every other joint is parked.",
        "[options.default]",
        f"fingers = [{', '.join(_text(names[tip]) for tip in chosen[:3])}]",
        *_parked_lines(parked),
    ]
    for tip, pad in zip(chosen, pads, strict=True):
        lines += ["", "[[finger]]", f"name = {_text(names[tip])}"]
        lines += [f"joints = [{', '.join(map(_text, chains[tip]))}]", f"tip_link = {_text(tip)}", *_pad_lines(pad)]
    lines += ["", "[self_collision]", "# The pairs of links that meet in some random postures, but not in nearly all."]
    lines += ["pairs = [", *(f"  [{_text(a)}, {_text(b)}]," for a, b in pairs), "]", ""]
    return "\n".join(lines)


def _coupling_lines(coupling: dict[str, tuple[str, float, float]]) -> list[str]:
    """Write which joint follows which."""
    lines = ["", "# joint = ratio * source + offset", "[coupling]"] if coupling else []
    for joint, (source, ratio, offset) in coupling.items():
        lines.append(f"{_text(joint)} = {{ source = {_text(source)}, ratio = {ratio!r}, offset = {offset!r} }}")
    return lines


def _parked_lines(parked: dict[str, float]) -> list[str]:
    """Write where the joints that do not grasp are."""
    row = ", ".join(f"{_text(joint)} = {value!r}" for joint, value in parked.items())
    return [f"parked = {{ {row} }}  # CHECK: out of the way of the others"] if parked else []


def _pad_lines(pad: Pad) -> list[str]:
    """Write where a fingertip touches."""
    lines = [f"contact = {_list(pad.contact)}  # CHECK: the middle of the pad", f"normal = {_list(pad.normal)}"]
    if pad.radius:
        return [*lines, 'tip = "sphere"', f"center = {_list(pad.center)}", f"radius = {pad.radius!r}"]
    return [*lines, 'tip = "point"']


def fingertip_links(urdf: Urdf) -> tuple[str, ...]:
    """Return the last link with a collision shape of every branch that a joint moves, in the order of the file."""
    parents, shaped = {j.parent for j in urdf.joints}, {x.name for x in urdf.links if x.shapes}
    ends = []
    for link in (x.name for x in urdf.links if x.name not in parents):
        above = urdf.joints_above(link)
        ends += [x for x in (link, *(j.parent for j in above)) if x in shaped][:1]
    return tuple(e for e in dict.fromkeys(ends) if any(j.kind != "fixed" for j in urdf.joints_above(e)))


def guess_pads(urdf: Urdf, frames: Float[Tensor, "3 4 l n"], tips: Sequence[str]) -> tuple[tuple[Pad, ...], Triple]:
    """Return the pads of fingertips and the direction out of the palm, from random postures.

    Args:
        urdf: the hand's tree.
        frames: of its links in n postures.
        tips: links of the fingertips, the three that grasp first.
    """
    links = {x.name: i for i, x in enumerate(urdf.links)}
    index = torch.tensor([links[tip] for tip in tips])
    shapes = [_end_shape(urdf.links[i]) for i in index.tolist()]
    cores = [_core(shape) for shape in shapes]
    at = frames.index_select(2, index)
    centres = map_points(at, torch.tensor(np.stack(cores)))  # 3 f n
    middle = centres[:, :3].mean(1, keepdim=True)
    spread = torch.linalg.vector_norm(centres[:, :3] - middle, dim=0).sum(0)
    near = spread.topk(max(1, int(NEAR * len(spread))), largest=False).indices
    toward = (at[:, :3] * (middle - centres)[:, None])[..., near].sum(0).mean(-1).T.numpy()  # in the tips' frames
    pads = []
    for tip, shape, core, closing in zip(tips, shapes, cores, toward, strict=True):
        joint, motion, outward = _motion(urdf, tip, core)
        middle_of_range = (joint.lower + joint.upper) / 2
        one_sided = abs(middle_of_range) > ONE_SIDED * (joint.upper - joint.lower)
        bending = math.copysign(1.0, middle_of_range if one_sided else motion @ closing)
        pads.append(_pad(shape, core, bending * motion, outward))
    out = middle[:, 0, near].mean(1).numpy() - _palm_centre(urdf)
    axis = int(np.abs(out).argmax())
    return tuple(pads), _triple(np.sign(out[axis]) * np.eye(3)[axis])


def _motion(
    urdf: Urdf, tip: str, core: Float[np.ndarray, "3"]
) -> tuple[Joint, Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the last joint that moves a tip, how it moves it, and the way from it: directions in the tip's frame."""
    tip_from_above = np.eye(4)
    for joint in urdf.joints_above(tip):
        place = tip_from_above[:3, 3]
        if joint.kind != "fixed":
            axis, arm = tip_from_above[:3, :3] @ np.array(joint.axis), core - place
            motion = axis if joint.kind == "prismatic" else np.cross(axis, arm)
            length = float(np.linalg.norm(motion))
            if length > SHORT:  # else the tip turns on the spot
                arm = arm - (arm @ axis) * axis
                return joint, motion / length, arm / max(float(np.linalg.norm(arm)), SHORT)
        above_from_link = np.eye(4)
        above_from_link[:3, :3], above_from_link[:3, 3] = rotation_from_rpy(joint.rpy).numpy(), joint.xyz
        tip_from_above = tip_from_above @ np.linalg.inv(above_from_link)
    raise BadArgument("tips", tip, "links that a joint moves")


def _chain(urdf: Urdf, tip: str, known: Sequence[str]) -> tuple[str, ...]:
    """Return the movable joints above a fingertip, those at the palm first; refuse what is no fingertip."""
    link = next((x for x in urdf.links if x.name == tip), None)
    joints = () if link is None else tuple(j.name for j in urdf.joints_above(tip) if j.kind != "fixed")[::-1]
    if link is None or not link.shapes or not joints:
        raise BadArgument("tips", tip, f"links with a collision shape that joints move, as {list(known)}")
    return joints


def _palm_centre(urdf: Urdf) -> Float[np.ndarray, "3"]:
    """Return the middle of the root's collision shapes."""
    root = next(x for x in urdf.links if x.name == urdf.root)
    return np.mean([s.xyz for s in root.shapes], axis=0) if root.shapes else np.zeros(3)


def _end_shape(link: Link) -> Shape:
    """Return the shape of a link that reaches farthest from its joint."""
    return max(link.shapes, key=lambda s: math.dist(s.xyz, (0.0, 0.0, 0.0)))


def _half(shape: Shape) -> Float[np.ndarray, "3"]:
    """Return the half sizes of a box, of a cylinder or of a sphere."""
    if shape.kind == "box":
        return np.array(shape.size) / 2
    radius = shape.size[0]
    return np.array([radius, radius, radius if shape.kind == "sphere" else shape.size[1] / 2])


def _core(shape: Shape) -> Float[np.ndarray, "3"]:
    """Return the middle of the end of a tip: one half thickness before its far end, in the link's frame."""
    center, half = np.array(shape.xyz), _half(shape)
    turn = rotation_from_rpy(shape.rpy).numpy()
    along = int(half.argmax())
    outward = turn[:, along] @ center
    inset = half[along] - np.delete(half, along).min()
    return center + math.copysign(inset, outward) * turn[:, along]


def _pad(
    shape: Shape,
    core: Float[np.ndarray, "3"],
    motion: Float[np.ndarray, "3"],
    outward: Float[np.ndarray, "3"],
) -> Pad:
    """Return the pad of a tip that closes along `motion`: on a sphere tilted outward, else in the middle of a side."""
    if shape.kind == "sphere":
        normal, radius = math.cos(TILT) * motion + math.sin(TILT) * outward, shape.size[0]
        center, normal = np.array(shape.xyz), normal / np.linalg.norm(normal)
        return Pad(_triple(center + radius * normal), _triple(normal), _triple(center), radius)
    turn, half = rotation_from_rpy(shape.rpy).numpy(), _half(shape)
    side = turn.T @ motion
    side[int(half.argmax())] = 0.0  # along the tip's length there is no pad
    if shape.kind == "box":
        face = int(np.abs(side).argmax())
        side, depth = np.sign(side[face]) * np.eye(3)[face], half[face]
    else:
        side, depth = side / np.linalg.norm(side), shape.size[0]
    contact = core + depth * (turn @ side)
    return Pad(_triple(contact), _triple(turn @ side), _triple(contact), 0.0)


def _triple(x: Float[np.ndarray, "3"]) -> Triple:
    """Return an array as three numbers that print shortly."""
    a, b, c = (round(float(v), 12) + 0.0 for v in x)
    return a, b, c


def _list(x: Triple) -> str:
    """Write three numbers."""
    return "[" + ", ".join(f"{v:.12g}" for v in x) + "]"


def _text(x: str) -> str:
    """Write a word in quotes that TOML reads back."""
    return json.dumps(x, ensure_ascii=False)
