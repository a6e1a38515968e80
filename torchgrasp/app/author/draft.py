"""A first hand.toml for a URDF, and a clean copy of the URDF: fingers, pads, coupling, pairs of links.

What a published URDF says is mended (`mend`), its meshes become simple shapes (`fit_shapes`), its pads are guessed
(`pads`). Every guess is marked.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.author.fit_shapes import ball_tip, replace_meshes, shape_points
from torchgrasp.app.author.pads import guess_pads, is_primitive, order_by_facing, palm_of
from torchgrasp.app.author.repair import fix_wrist, keep_below, mend_bodies, mend_joints, merge_frames, urdf_text
from torchgrasp.base import FINGERTIPS
from torchgrasp.checks import Seed, checked
from torchgrasp.errors import BadArgument
from torchgrasp.hand.collision_shapes import collision_pairs, draw_postures
from torchgrasp.hand.hand_toml import Pad
from torchgrasp.hand.kinematics import tree_from_urdf
from torchgrasp.hand.urdf import MEND, Mimic, Triple, Urdf, read_published

DRAFT_POSTURES = 20_000
"""Random postures from which pads and approach are guessed."""
STIFFNESS, DAMPING = 4.0, 0.03
"""Drive [rad^-1] per N m of the weakest joint's effort, and its damping [s]: about those of the shipped hands."""
MOST_STIFFNESS = 10.0
"""Stiffest drive [N m/rad]: the Barrett's, which is the strongest of the shipped hands."""
ROTOR = 1e-3
"""Inertia [kg m2] that simulations add to every joint for its motor."""

OPTIONS = {"default": 3, "four": 4, "five": 5}
"""Sets of fingers that a draft declares, as far as the hand has as many."""

Chosen = dict[str, Pad]
"""Pads by the links that touch."""
Sets = dict[str, list[str]]
"""Links that touch by the option of hand.toml in which their fingers grasp."""


class Draft(NamedTuple):
    """A first hand.toml, the clean URDF that it speaks of, and sentences on what was mended.

    `urdf` is empty where the URDF is clean as it is.

    >>> Draft('name = "mine"', urdf="", mended=()).toml
    'name = "mine"'
    """

    toml: str
    urdf: str
    mended: tuple[str, ...]


class Wish(NamedTuple):
    """What a user may say of a hand: the links of its tips, its name, the root below an arm, the folder of meshes.

    >>> Wish(tips=("thumb_tip", "index_tip", "ring_tip"), name="mine").root
    ''
    """

    tips: tuple[str, ...] = ()
    name: str = ""
    root: str = ""
    meshes: Path | None = None


@checked
def draft_hand(path: Path | str, tips: Sequence[str] = (), name: str | None = None, seed: Seed = 0) -> str:
    """Write the text of a hand.toml for a clean URDF, to be looked over and checked by `check_hand`.

    Args:
        path: of the URDF.
        tips: links of the fingertips in grasp order, first the three of option "default"; "four" and "five" add the
            next. By default the ends of the tree's branches, in the order in which their pads best face each other.
        name: of the hand; by default the robot's.
        seed: of the random postures.

    Raises:
        HandFileError: the URDF is missing or malformed, or needs mending: `new_hand` does that.
        BadArgument: fewer than three tips, more than five, or one without a collision shape or a joint that moves it.

    >>> from torchgrasp.hand.load import find_hand
    >>> text = draft_hand(find_hand("barrett") / "hand.urdf")
    >>> '"f1_distal" = { source = "f1_flex"' in text
    True
    """
    draft = new_hand(path, Wish(tuple(tips), name or ""), seed)
    if draft.urdf:
        raise read_published(path).wrong("; ".join(draft.mended)[:1000], f"a clean URDF; {MEND}")
    return draft.toml


@checked
def new_hand(path: Path | str, wish: Wish = Wish(), seed: Seed = 0, file: str = "hand.urdf") -> Draft:  # noqa: B008
    """Mend a published URDF, and draft a hand.toml for the clean copy, which is to be called `file`.

    Raises:
        HandFileError: the URDF or a mesh of it is missing, malformed or hostile, or nothing can mend it.
        BadArgument: fewer than three tips, more than five, or one without a collision shape or a joint that moves it.

    >>> from torchgrasp import load_hand
    >>> draft = new_hand(load_hand("barrett").urdf_path, Wish(name="mine"))
    >>> 'name = "mine"' in draft.toml, draft.mended
    (True, ())
    """
    published = read_published(path)
    urdf, told = keep_below(published, wish.root or published.root)
    urdf, more, taken = merge_frames(urdf)
    told += more
    urdf, more = fix_wrist(urdf, fingertip_links(urdf) or [urdf.root])
    urdf, again, taken_again = merge_frames(urdf)
    told += more + again
    urdf, more = mend_joints(urdf)
    told += more
    points = shape_points(urdf, wish.meshes or published.path.parent)
    surfaces = {name: np.concatenate(parts) for name, parts in points.items() if parts}
    urdf, more = mend_bodies(urdf, surfaces)
    told += more
    tips = tuple(taken_again.get(x, x) for x in (taken.get(tip, tip) for tip in wish.tips))
    tips = _checked_tips(urdf, tips)
    frames = _frames(urdf, (*tips, palm_of(urdf, tips)), seed)
    guess = guess_pads(urdf, frames, tips, surfaces)
    order = list(range(len(tips)))
    if not wish.tips:
        order = order_by_facing(frames[:, :, :-1], guess.pads)
    sets = {name: [tips[k] for k in sorted(order[:n])] for name, n in OPTIONS.items() if n <= len(tips)}
    simple = {x.name for x in urdf.links if is_primitive(x)}
    clean, more = replace_meshes(urdf, points)
    told += more
    chosen: Chosen = {}
    balls = list[str]()
    for tip, pad, outward in zip(tips, guess.pads, guess.outward, strict=True):
        if tip not in simple:
            balls.append(f"{tip} {1e3 * pad.radius:.1f} mm")
            clean = ball_tip(clean, tip, pad, outward, surfaces[tip])
        chosen[tip] = pad
    told += [f"fingertips touch by a ball in their end, of radius: {', '.join(balls)}"] if balls else []
    name, mended = wish.name or urdf.name, bool(told)
    toml = _toml_text(clean, chosen, sets, guess.approach, (name, file if mended else published.path.name), seed)
    return Draft(toml, urdf_text(clean) if mended else "", tuple(told))


def _frames(urdf: Urdf, links: tuple[str, ...], seed: int) -> Float[Tensor, "3 4 _ n"]:
    """Return the frames of some links in random postures; a part at a time, since those of all links are many."""
    tree, at = tree_from_urdf(urdf), [[x.name for x in urdf.links].index(link) for link in links]
    values = draw_postures(urdf, _coupling(urdf), DRAFT_POSTURES, seed)
    return torch.cat([tree.frames(part)[:, :, at] for part in values.split(1000, 1)], -1)


def _checked_tips(urdf: Urdf, tips: tuple[str, ...]) -> tuple[str, ...]:
    """Return the links of the fingertips, given or found; refuse too few, and links that cannot touch."""
    ends = fingertip_links(urdf)
    chosen = tips or ends
    if not FINGERTIPS[0] <= len(chosen) <= FINGERTIPS[1] or len(set(chosen)) < len(chosen):
        wanted = f"three to five different links in grasp order; the branches of {urdf.path} end in {list(ends)}"
        raise BadArgument("tips", list(tips) or f"none, and {len(ends)} fingers", wanted)
    shaped = {x.name for x in urdf.links if x.shapes}
    for tip in chosen:
        if tip not in shaped or not urdf.movers(tip):
            raise BadArgument("tips", tip, f"links with a collision shape that joints move, as {list(ends)}")
    return chosen


def _coupling(urdf: Urdf) -> dict[str, Mimic]:
    return {j.name: j.mimic for j in urdf.movable if j.mimic is not None}


def _gains(urdf: Urdf) -> tuple[float, float]:
    """Return stiffness and damping of the drives: of the weakest joint's effort, and no less than critical damping."""
    free = [j for j in urdf.movable if j.mimic is None]
    kp = min(STIFFNESS * min(j.effort for j in free), MOST_STIFFNESS)
    poses = tree_from_urdf(urdf).poses(torch.zeros(1, len(urdf.movable), dtype=torch.float64))[0].numpy()
    names = [x.name for x in urdf.links]
    centres = np.array([p[:3, :3] @ x.com + p[:3, 3] for p, x in zip(poses, urdf.links, strict=True)])
    heaviest = 0.0
    for j in free:
        if j.kind == "prismatic":
            continue
        pose = poses[names.index(j.child)]
        moved = [k for k, name in enumerate(names) if j in urdf.joints_above(name)]
        arms = np.cross(pose[:3, :3] @ j.axis, centres[moved] - pose[:3, 3])
        heaviest = max(heaviest, float(np.array([urdf.links[k].mass for k in moved]) @ (arms**2).sum(1)))
    return kp, max(DAMPING * kp, 2 * np.sqrt(kp * (heaviest + ROTOR)))


def _toml_text(urdf: Urdf, pads: Chosen, sets: Sets, approach: Triple, names: tuple[str, str], seed: int) -> str:
    """Write a hand.toml; `names` are those of the hand and of its URDF's file."""
    coupling = _coupling(urdf)
    chains = {tip: [j.name for j in urdf.movers(tip)[::-1]] for tip in pads}
    kp, kd = _gains(urdf)
    called = {tip: tip.removesuffix("_tip") for tip in pads}
    lines = [
        "# A draft. Lengths [m], angles [rad], in the link frames of the URDF. Look over what is marked CHECK.",
        f"name = {_toml(names[0])}",
        f"urdf = {_toml(names[1])}",
        f"base_link = {_toml(urdf.root)}",
        f"approach = {_toml(approach)}  # CHECK: out of the palm",
        "limit_margin = 0.0  # taken off both ends of every joint's range",
        "",
        "[actuators]  # joint position control; effort [N m] and velocity [rad/s] are those of the URDF",
        f"kp = {kp:.3g}  # CHECK: [N m/rad]",
        f"kd = {kd:.3g}  # [N m s/rad]",
    ]
    if coupling:
        lines += ["", "# joint = ratio * source + offset", "[coupling]"]
    for joint, (source, ratio, offset) in coupling.items():
        lines.append(f"{_toml(joint)} = {{ source = {_toml(source)}, ratio = {ratio!r}, offset = {offset!r} }}")
    lines += ["", "# Which fingers grasp, in grasp order; every other joint is parked."]
    for option, tips in sets.items():
        guessed = "  # CHECK" if len(tips) < len(pads) else ""
        lines += [f"[options.{option}]", f"fingers = {_toml([called[tip] for tip in tips])}{guessed}"]
        parked = _parked(urdf, {joint for tip in tips for joint in chains[tip]})
        if parked:
            row = ", ".join(f"{_toml(joint)} = {value!r}" for joint, value in parked.items())
            lines.append(f"parked = {{ {row} }}  # CHECK: out of the way of the others")
        lines.append("")
    for tip, pad in pads.items():
        lines += ["[[finger]]", f"name = {_toml(called[tip])}"]
        lines += [f"joints = {_toml(chains[tip])}", f"tip_link = {_toml(tip)}"]
        lines += [f"contact = {_toml(pad.contact)}  # CHECK: the middle of the pad", f"normal = {_toml(pad.normal)}"]
        sphere = ['tip = "sphere"', f"center = {_toml(pad.center)}", f"radius = {pad.radius!r}"]
        lines += [*(sphere if pad.radius else ['tip = "point"']), ""]
    lines += ["[self_collision]", "# The pairs of links that meet in some random postures, but not in nearly all."]
    lines += ["pairs = [", *(f"  {_toml(pair)}," for pair in collision_pairs(urdf, coupling, seed=seed)), "]", ""]
    return "\n".join(lines)


def _parked(urdf: Urdf, grasping: set[str]) -> dict[str, float]:
    """Return where the joints are that neither grasp nor lead nor follow another: at zero, or the limit next to it."""
    coupling = _coupling(urdf)
    moved = grasping | {coupling[j].source for j in grasping if j in coupling}
    free = (j for j in urdf.movable if j.name not in coupling and j.name not in moved)
    return {j.name: min(max(0.0, j.lower), j.upper) for j in free}


def fingertip_links(urdf: Urdf) -> tuple[str, ...]:
    """Return every movable branch's last link with a collision shape."""
    parents, shaped = {j.parent for j in urdf.joints}, {x.name for x in urdf.links if x.shapes}
    ends = []
    for link in (x.name for x in urdf.links if x.name not in parents):
        ends += [x for x in (link, *(j.parent for j in urdf.joints_above(link))) if x in shaped][:1]
    return tuple(e for e in dict.fromkeys(ends) if urdf.movers(e))


def _toml(x: object) -> str:
    return json.dumps(x, ensure_ascii=False)
