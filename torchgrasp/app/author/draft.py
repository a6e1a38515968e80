"""A first hand.toml for a URDF, and a clean copy of the URDF: fingers, pads, coupling, pairs of
links.

A published URDF is repaired (`repair`), its meshes are replaced by simple shapes (`fit_shapes`),
and the fingertip pads are guessed (`pads`). Every guess is marked in the text.
"""

import dataclasses
import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.author.fit_shapes import ball_tip, replace_meshes, shape_points
from torchgrasp.app.author.pads import guess_pads, is_primitive, order_by_facing, palm_of
from torchgrasp.app.author.repair import (
    fix_wrist,
    keep_below,
    merge_frames,
    repair_bodies,
    repair_joints,
)
from torchgrasp.files import render
from torchgrasp.foundation.base import FINGERTIPS
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Seed
from torchgrasp.hand.collision_shapes import collision_pairs, draw_postures
from torchgrasp.hand.hand_toml import Pad
from torchgrasp.hand.kinematics import tree_from_urdf
from torchgrasp.hand.urdf import REPAIR, SIZES, Mimic, Triple, Urdf, read_published

OPTIONS = {"default": 3, "four": 4, "five": 5}
"""Sets of fingers that a draft declares if the hand has as many."""
MOST_ERROR = 1000  # of the list of repairs in an error [characters]


@dataclasses.dataclass(frozen=True)
class DraftNumbers:
    """Numbers of the random postures from which pads are guessed, and of the drives of a draft."""

    postures: int = 20_000  # number of random postures
    chunk: int = 1000  # postures whose poses are computed at once, to bound the memory
    rotor: float = 1e-3  # inertia [kg m2] that simulations add to each joint
    stiffness: float = 4.0  # stiffness of a drive [1/rad], over the effort of the weakest joint
    most_stiffness: float = 10.0  # greatest stiffness of a drive [N m/rad]
    damping: float = 0.03  # least time constant [s]: the ratio of damping to stiffness


DRAFT = DraftNumbers()


class Draft(NamedTuple):
    """A first hand.toml for a URDF, and the repaired URDF.

    Attributes:
        toml: text of the hand.toml.
        urdf: text of the clean URDF to which it refers; "" if the published URDF is clean.
        repairs: a sentence for each repair of the URDF.
    """

    toml: str
    urdf: str
    repairs: tuple[str, ...]


class Wish(NamedTuple):
    """The user's choices for a new hand; an empty choice is made by the draft.

    Attributes:
        tips: links of the fingertips in grasp order.
        name: name of the hand, by default the robot's.
        root: first link of the hand, where the URDF has an arm, too.
        meshes: folder of all meshes, by default the URDF's.
    """

    tips: tuple[str, ...] = ()
    name: str = ""
    root: str = ""
    meshes: Path | None = None


NO_WISH = Wish()


@checked
def draft_hand(
    path: Path | str, tips: Sequence[str] = (), name: str | None = None, seed: Seed = 0
) -> str:
    """Return the text of a hand.toml for a clean URDF, for the user to review.

    `check_hand` checks it. `tips` are the links of the fingertips in grasp order. They form the
    hand.toml's sets of fingers: "default" has the first three, "four" the first four, and "five"
    all five. A set is left out if there are too few tips. By default the tips are the last links of
    the branches, in the order in which their pads best face each other. The hand has the `name` of
    the robot by default. `seed` is that of the random postures from which pads are guessed. Raises
    `HandFileError` for a URDF that is missing or malformed, or needs repair by `new_hand`. Raises
    `BadArgument` for fewer than three tips, more than five, or a tip without a collision shape or a
    movable joint.

    >>> from torchgrasp.hand.load import find_hand
    >>> text = draft_hand(find_hand("barrett") / "hand.urdf")
    >>> '"f1_distal" = { source = "f1_flex"' in text
    True
    """
    draft = new_hand(path, Wish(tuple(tips), name or ""), seed)
    if draft.urdf:
        repairs = "; ".join(draft.repairs)[:MOST_ERROR]
        raise read_published(path).wrong(repairs, f"a clean URDF {REPAIR}")
    return draft.toml


@checked
def new_hand(
    path: Path | str,
    wish: Wish = NO_WISH,
    seed: Seed = 0,
    file: str = "hand.urdf",
) -> Draft:
    """Repair a published URDF, and draft a hand.toml for the clean copy.

    The user saves the clean copy as `file`, which the hand.toml names. `wish` holds the user's
    choices; `seed` is that of the random postures from which pads are guessed. Raises the errors of
    `draft_hand`, and `HandFileError` for a mesh that is refused, or a URDF that cannot be repaired.

    >>> from torchgrasp import load_hand
    >>> draft = new_hand(load_hand("barrett").urdf_path, Wish(name="mine"))
    >>> 'name = "mine"' in draft.toml, draft.repairs
    (True, ())
    """
    published = read_published(path)
    # frames are merged twice: a wrist that is fixed leaves new ones
    urdf, below = keep_below(published, wish.root or published.root)
    urdf, merged, taken = merge_frames(urdf)
    urdf, fixed = fix_wrist(urdf, fingertip_links(urdf) or [urdf.root])
    urdf, again, taken_again = merge_frames(urdf)
    urdf, joints = repair_joints(urdf)
    points = shape_points(urdf, wish.meshes or published.path.parent)
    surfaces = {name: np.concatenate(parts) for name, parts in points.items() if parts}
    urdf, bodies = repair_bodies(urdf, surfaces)
    # a tip that the user named may have been merged into another link
    tips = tuple(taken.get(tip, tip) for tip in wish.tips)
    tips = _checked_tips(urdf, tuple(taken_again.get(tip, tip) for tip in tips))
    frames = _frames(urdf, (*tips, palm_of(urdf, tips)), seed)
    guess = guess_pads(urdf, frames, tips, surfaces)
    order = list(range(len(tips)))
    if not wish.tips:
        order = order_by_facing(frames[:, :, :-1], guess.pads)
    possible = {name: n for name, n in OPTIONS.items() if n <= len(tips)}
    sets = {name: [tips[k] for k in sorted(order[:n])] for name, n in possible.items()}
    simple = {x.name for x in urdf.links if is_primitive(x)}
    clean, fitted = replace_meshes(urdf, points)
    chosen = dict[str, Pad]()
    balls = list[str]()
    for tip, pad, outward in zip(tips, guess.pads, guess.outward, strict=True):
        if tip not in simple:
            balls.append(f"{tip} {1e3 * pad.radius:.1f} mm")
            clean = ball_tip(clean, tip, pad, outward, surfaces[tip])
        chosen[tip] = pad
    repairs = [*below, *merged, *fixed, *again, *joints, *bodies, *fitted]
    if balls:
        repairs.append(f"fingertips touch with a ball in their end, of radius: {', '.join(balls)}")
    names = wish.name or urdf.name, file if repairs else published.path.name
    toml = _toml_text(clean, chosen, sets, guess.approach, names, seed)
    return Draft(toml, _urdf_text(clean) if repairs else "", tuple(repairs))


@checked
def clean_arm(path: Path | str, meshes: Path | str | None = None) -> str:
    """Return the URDF of a published arm with boxes and cylinders instead of meshes, as `load_arm`
    needs it.

    The meshes lie below the folder `meshes`, by default that of the URDF. A joint without limits
    gets half a turn either way. Raises the errors of `new_hand`.

    >>> from torchgrasp import load_hand
    >>> clean_arm(load_hand("barrett").urdf_path).splitlines()[0]
    '<robot name="barrett">'
    """
    urdf, _ = repair_joints(read_published(path))
    clean, _ = replace_meshes(urdf, shape_points(urdf, Path(meshes or urdf.path.parent)))
    return _urdf_text(clean)


def _frames(urdf: Urdf, links: tuple[str, ...], seed: int) -> Float[Tensor, "3 4 _ n"]:
    """Return the poses (3 x 4) of some links in random postures."""
    tree = tree_from_urdf(urdf)
    names = [x.name for x in urdf.links]
    at = [names.index(link) for link in links]
    values = draw_postures(urdf, _coupling(urdf), DRAFT.postures, seed)
    return torch.cat([tree.frames(part)[:, :, at] for part in values.split(DRAFT.chunk, 1)], -1)


def _checked_tips(urdf: Urdf, tips: tuple[str, ...]) -> tuple[str, ...]:
    """Return the given fingertip links, else those found; raise `BadArgument` if their number or a
    link is unusable.
    """
    ends = fingertip_links(urdf)
    chosen = tips or ends
    if not FINGERTIPS[0] <= len(chosen) <= FINGERTIPS[1] or len(set(chosen)) < len(chosen):
        wanted = (
            "three to five different links in grasp order; "
            f"the branches of {urdf.path} end in {list(ends)}"
        )
        raise BadArgument("tips", list(tips) or f"a hand of {len(ends)} fingers", wanted)
    shaped = {x.name for x in urdf.links if x.shapes}
    for tip in chosen:
        if tip not in shaped or not urdf.movers(tip):
            wanted = f"links with a collision shape that joints move, such as {list(ends)}"
            raise BadArgument("tips", tip, wanted)
    return chosen


def _coupling(urdf: Urdf) -> dict[str, Mimic]:
    return {j.name: j.mimic for j in urdf.movable if j.mimic is not None}


def _gains(urdf: Urdf) -> tuple[float, float]:
    """Return stiffness [N m/rad] and damping [N m s/rad] for the drives, similar to those of the
    shipped hands.
    """
    free = [j for j in urdf.movable if j.mimic is None]
    kp = min(DRAFT.stiffness * min(j.effort for j in free), DRAFT.most_stiffness)
    zero = torch.zeros(1, len(urdf.movable), dtype=torch.float64)
    poses = tree_from_urdf(urdf).poses(zero)[0].numpy()  # (l, 4, 4)
    names = [x.name for x in urdf.links]
    placed = zip(poses, urdf.links, strict=True)
    centres = np.array([pose[:3, :3] @ x.com + pose[:3, 3] for pose, x in placed])
    # greatest inertia that a joint turns, of all links beyond it as points
    heaviest = 0.0
    for j in free:
        if j.kind == "prismatic":
            continue
        pose = poses[names.index(j.child)]
        moved = [k for k, name in enumerate(names) if j in urdf.joints_above(name)]
        arms = np.cross(pose[:3, :3] @ j.axis, centres[moved] - pose[:3, 3])
        masses = np.array([urdf.links[k].mass for k in moved])
        heaviest = max(heaviest, float(masses @ (arms**2).sum(1)))
    critical = 2 * np.sqrt(kp * (heaviest + DRAFT.rotor))
    return kp, max(DRAFT.damping * kp, critical)


def _toml_text(
    urdf: Urdf,
    pads: dict[str, Pad],
    sets: dict[str, list[str]],
    approach: Triple,
    names: tuple[str, str],
    seed: int,
) -> str:
    """Return the text of a hand.toml from pads by tip, sets of tips by option, and the names of
    hand and URDF file.
    """
    coupling = _coupling(urdf)
    kp, kd = _gains(urdf)
    chains = {tip: [j.name for j in urdf.movers(tip)[::-1]] for tip in pads}
    called = {tip: tip.removesuffix("_tip") for tip in pads}
    options = {}
    for option, grasping in sets.items():
        joints = {joint for tip in grasping for joint in chains[tip]}
        options[option] = ([called[tip] for tip in grasping], _parked(urdf, joints))
    return _render(
        "hand.toml",
        name=names[0],
        file=names[1],
        urdf=urdf,
        approach=approach,
        kp=kp,
        kd=kd,
        coupling=coupling,
        options=options,
        pads=pads,
        names=called,
        chains=chains,
        pairs=collision_pairs(urdf, coupling, seed=seed),
    )


def _urdf_text(urdf: Urdf) -> str:
    """Return the text of a clean URDF."""
    return _render("hand.urdf", urdf=urdf, sizes=SIZES)


def _render(template: str, **values: Any) -> str:
    """Return the text of a file from its template."""
    filters = {"toml": functools.partial(json.dumps, ensure_ascii=False), "xml": _quoted}
    return render(Path(__file__).with_name(f"{template}.jinja"), filters, **values)


def _quoted(value: str | float | Sequence[float]) -> str:
    """Return the quoted value of an XML attribute, a text or numbers; negative zero is written as
    zero.
    """
    if isinstance(value, str):
        return quoteattr(value)
    return quoteattr(" ".join(f"{x + 0.0!r}" for x in np.ravel(value).tolist()))


def _parked(urdf: Urdf, grasping: set[str]) -> dict[str, float]:
    """Return the positions at which joints that do not take part in grasping are parked: zero, or
    the nearest limit.
    """
    coupling = _coupling(urdf)
    moved = grasping | {coupling[j].source for j in grasping if j in coupling}
    return {j.name: j.rest for j in urdf.movable if j.name not in coupling and j.name not in moved}


def fingertip_links(urdf: Urdf) -> tuple[str, ...]:
    """Return the names of the fingertip links of a URDF.

    These are the last links with a collision shape on the branches that joints move.
    """
    parents = {j.parent for j in urdf.joints}
    shaped = {x.name for x in urdf.links if x.shapes}
    ends = []
    for link in urdf.links:
        if link.name in parents:
            continue
        branch = (link.name, *(j.parent for j in urdf.joints_above(link.name)))
        ends += [x for x in branch if x in shaped][:1]
    return tuple(e for e in dict.fromkeys(ends) if urdf.movers(e))
