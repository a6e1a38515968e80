"""A first hand.toml for a URDF, and a clean copy of the URDF: fingers, pads, coupling, pairs of
links.

A published URDF is repaired (`repair`), and its meshes are replaced by simple shapes
(`fit_shapes`). Then the fingertip pads are guessed (`pads`). Every guess is marked in the text.
"""

import dataclasses
import functools
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.app.author.fit_shapes import Points, ball_tip, replace_meshes, shape_points
from torchgrasp.app.author.mjcf import FromMjcf, read_mjcf
from torchgrasp.app.author.mjcf_text import is_mjcf
from torchgrasp.app.author.pads import Guess, guess_pads, is_primitive, order_by_facing, palm_of
from torchgrasp.app.author.repair import (
    fix_wrist,
    keep_below,
    merge_frames,
    merge_markers,
    repair_bodies,
    repair_joints,
)
from torchgrasp.app.author.sensor_tips import (
    add_seen_sensors,
    add_sensors,
    extend_pads,
    find_sensors,
)
from torchgrasp.app.author.unusual import find_unusual
from torchgrasp.app.author.visuals import keep_visuals, mesh_files
from torchgrasp.files import render, temporary_folder
from torchgrasp.foundation.base import FINGERTIPS
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.foundation.rules import Seed
from torchgrasp.hand.collision_shapes import collision_pairs, draw_postures, met_pairs
from torchgrasp.hand.hand_toml import Pad, leading
from torchgrasp.hand.kinematics import tree_from_urdf
from torchgrasp.hand.safe_xml import seen_links
from torchgrasp.hand.urdf import REPAIR, SIZES, Mimic, Triple, Urdf, read_published

OPTIONS = {"default": 3, "four": 4, "five": 5}
"""Sets of fingers that a draft declares if the hand has as many."""
MOST_ERROR = 1000  # of the list of repairs in an error [characters]


@dataclasses.dataclass(frozen=True)
class DraftNumbers:
    """Numbers of the random postures from which pads are guessed, and of the drives of a draft."""

    postures: int = 20_000  # number of random postures
    # number of postures whose poses are computed at once, which bounds the memory
    chunk: int = 1000
    rotor: float = 1e-3  # inertia [kg m2] that simulations add to each joint
    # stiffness of a drive [N m/rad] for each N m of effort of the weakest joint
    stiffness: float = 4.0
    most_stiffness: float = 10.0  # greatest stiffness of a drive [N m/rad]
    # stiffness of a drive [N/m] for each N of effort of the weakest joint, if all joints slide; the
    # whole effort then moves a fingertip by 10 mm
    slide_stiffness: float = 100.0
    most_slide_stiffness: float = 1e4  # greatest stiffness of a drive [N/m], if all joints slide
    damping: float = 0.03  # least ratio of damping to stiffness of a drive: its time constant [s]
    # number of random postures of each set of fingers in which one without collision is sought
    trials: int = 1000
    # If fewer postures than this share are free of self-collision, pairs of links that collide often
    # are no longer tested. Their shapes are too coarse: real fingers seldom meet.
    least_free: float = 0.02
    # two links of one finger collide often if they do in this share of the postures or more
    most_within: float = 0.25
    # two links of different fingers collide often if they do in this share of the postures or more
    most_between: float = 0.5
    listed: int = 5  # greatest number of pairs of links that a warning names
    thin: float = 6e-3  # thickness [m] of a link below which it may be no fingertip


DRAFT = DraftNumbers()


class Draft(NamedTuple):
    """A first hand.toml, the file that describes a hand (docs/hands.md), with a repaired URDF;
    `new_hand` returns it.

    Attributes:
        toml: text of the hand.toml.
        urdf: text of the repaired URDF, which the hand.toml names. It is "" if nothing had to be
            repaired; the hand.toml then names the published URDF.
        repairs: a sentence for each repair of the URDF.
        warnings: sentences on implausible numbers of the URDF and guesses that are likely wrong.
            They also name links without <collision>, pairs of links that often collide, and what
            of an MJCF is left out. `toml` repeats them as comments.
        meshes: bytes of each visual mesh file that `urdf` names, by its path relative to the URDF.
            Only pictures use them.
    """

    toml: str
    urdf: str
    repairs: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    meshes: Mapping[str, bytes] = MappingProxyType({})


class Wish(NamedTuple):
    """The user's choices for a new hand (`new_hand`). What is left empty is guessed.

    Attributes:
        tips: names of the fingertip links, three to five; the first three grasp by default. ()
            means the last link of each branch.
        name: name of the hand; "" means the robot's name in the URDF.
        root: name of the hand's first link, if the URDF also has an arm. Links that are not below
            it are left out. "" means the root link of the URDF. In an MJCF it is the name of a
            body. "" then means the body fixed to the world that carries the driven fingers. If
            several bodies carry them, or one that itself moves, "" means the world.
        meshes: folder in which all mesh files lie; None means the folder of the URDF.
        visual: whether links without <collision> take their <visual> as collision shapes.
        tip_offset: lengths [m] by which tactile sensors extend the fingertips. () means no sensors.
            One number counts for all fingertips, several for each of `tips`; 0 adds no sensor. A
            sensor points along the perpendicular from the axis of the finger's last joint to the
            fingertip's end. The pad is the part of the fingertip that touches objects. Its contact
            point moves by the offset in this direction; its normal stays.
        tip_radius: radii [m] of the balls in which the sensors end, counted like `tip_offset`. ()
            means the radii of the guessed pads, which are parts of balls. A flat pad has no such
            radius; a sensor on it needs one here.
    """

    tips: tuple[str, ...] = ()
    name: str = ""
    root: str = ""
    meshes: Path | None = None
    visual: bool = False
    tip_offset: tuple[float, ...] = ()
    tip_radius: tuple[float, ...] = ()


NO_WISH = Wish()


@checked
def draft_hand(
    path: Path | str, tips: Sequence[str] = (), name: str | None = None, seed: Seed = 0
) -> str:
    """Return the text of a hand.toml, the file that describes a hand, for a clean URDF; the user
    reviews it.

    `torchgrasp.testing.check_hand` checks the finished hand. The hand.toml has up to three sets of
    fingers that grasp: "default" with three tips, "four" and "five".

    Args:
        path: the URDF. It must need no repair; `new_hand` repairs others.
        tips: names of three to five fingertip links; each set has the first ones. Empty means the
            last link of each branch; each set then has the tips whose pads face each other best. A
            pad is the part of a tip that touches objects.
        name: name of the hand; None means the robot's name in the URDF.
        seed: seed of the random postures from which the fingertip pads are guessed.

    Raises:
        HandFileError: a URDF or a mesh that is missing or malformed, or a URDF that needs repair.
        BadArgument: fewer than three tips, more than five, or a tip without a collision shape or a
            movable joint.

    >>> from torchgrasp.hand.load import find_hand
    >>> text = draft_hand(find_hand("barrett") / "hand.urdf")
    >>> '"f1_distal" = { source = "f1_flex"' in text
    True
    """
    draft = new_hand(path, Wish(tuple(tips), name or ""), seed)
    if draft.urdf:
        repairs = "; ".join(draft.repairs)[:MOST_ERROR]
        raise HandFileError("urdf", f"{path}: {repairs}", f"a clean URDF {REPAIR}")
    return draft.toml


@checked
def new_hand(
    path: Path | str,
    wish: Wish = NO_WISH,
    seed: Seed = 0,
    file: str = "hand.urdf",
) -> Draft:
    """Return a hand.toml, the file that describes a hand, and a repaired URDF, for a published URDF
    or MJCF.

    Sometimes hardly any random posture is free of self-collision. Then the pairs of links that meet
    most often are no longer tested. A warning names them.

    Args:
        path: the URDF; or an MJCF (.xml, .mjcf), which MuJoCo reads and which becomes a URDF.
        wish: the user's choices, such as the fingertips.
        seed: seed of the random postures. By them the pads, the parts of the fingertips that touch
            objects, are guessed. They also tell which pairs of links are tested for collision.
        file: name of the file in which the user saves the repaired URDF; the hand.toml names it.

    Raises:
        HandFileError: a file or a mesh that is missing, malformed, too large or outside its folder.
        HandFileError: no collision shape, or a fault that cannot be repaired.
        BadArgument: an unknown root; fewer than three tips or more than five; a tip without a
            collision shape. Also a tip without a movable joint, or a bad length or radius of a
            sensor.
        MissingExtra: an MJCF without MuJoCo.

    >>> from torchgrasp import load_hand
    >>> draft = new_hand(load_hand("barrett").urdf_path, Wish(name="mine"))
    >>> 'name = "mine"' in draft.toml, draft.repairs
    (True, ())
    """
    if not is_mjcf(Path(path)):
        return _draft(read_published(path, wish.visual), wish, seed, file)
    with temporary_folder() as folder:
        found = read_mjcf(Path(path), folder, wish.root, wish.tips, wish.visual, wish.meshes)
        draft = _draft(found.urdf, wish._replace(meshes=folder), seed, file, found)
    return draft


def _draft(
    published: Urdf, wish: Wish, seed: int, file: str, origin: FromMjcf | None = None
) -> Draft:
    """Return the draft of `new_hand` for a URDF that was read, from an MJCF if it has an `origin`."""
    # what is a part of the hand
    bare = _bare_links(published, wish.visual)
    folder = wish.meshes or published.path.parent
    reduced = _reduce(published, wish, folder)
    urdf = reduced.urdf
    surfaces = reduced.surfaces
    tips = _checked_tips(urdf, _tips(reduced, wish, origin), () if wish.visual else bare)

    # where its pads are, and in which order the fingers grasp
    frames = _frames(urdf, (*tips, palm_of(urdf, tips)), seed)
    guess = guess_pads(urdf, frames, tips, surfaces)
    pads = extend_pads(tips, guess, wish.tip_offset, wish.tip_radius, bool(wish.tips))
    order = list(range(len(tips)))
    if not wish.tips:
        order = order_by_facing(frames[:, :, :-1], pads)
    possible = {name: n for name, n in OPTIONS.items() if n <= len(tips)}
    sets = {name: [tips[k] for k in sorted(order[:n])] for name, n in possible.items()}

    # simple shapes in place of its meshes
    clean, fitted = replace_meshes(urdf, reduced.points)
    clean, balls = _round_tips(urdf, clean, tips, guess, surfaces)
    sensors = find_sensors(tips, guess, pads)
    clean, extended = add_sensors(clean, sensors)

    # what the user is told
    told = origin.told if origin else ()
    repairs = [*told, *reduced.repairs, *fitted, *extended, *balls]
    warnings = [*(origin.warnings if origin else ()), *reduced.unusual]
    if bare and wish.visual:
        repairs.append(f"links without <collision> take their <visual>: {', '.join(bare)}")
    elif bare:
        warnings.append(
            f"links with a <visual> but no <collision> touch nothing: {', '.join(bare)} "
            "(--visual takes their <visual>)"
        )
    warnings += _thin_tips(tips, surfaces) + _mixed_joints(clean)

    options = _options(clean, sets)
    pairs, without = _part_pairs(clean, options, seed)
    warnings += without
    chosen = dict(zip(tips, pads, strict=True))
    name = wish.name or urdf.name
    urdf_file = file if repairs else published.path.name
    toml = _toml_text(clean, name, urdf_file, chosen, options, guess.approach, pairs, warnings)
    if not repairs:
        return Draft(toml, "", (), tuple(warnings))
    seen = keep_visuals(published, clean, reduced.mergers, folder)
    files = mesh_files(add_seen_sensors(seen, sensors))
    text = _urdf_text(clean, {link: path for link, (path, _) in files.items()})
    return Draft(toml, text, tuple(repairs), tuple(warnings), dict(files.values()))


class _Reduced(NamedTuple):
    """A hand's URDF without frames, markers, and what is cut off.

    Args:
        urdf: the repaired URDF.
        repairs: what was done to it, a sentence each.
        mergers: the links that took others up, by the names of the others; one dict for each pass.
        points: points [m] on the collision shapes of each link, one array for each shape.
        surfaces: the same points, one array for each link.
        unusual: warnings of what is unusual in it.
    """

    urdf: Urdf
    repairs: list[str]
    mergers: tuple[dict[str, str], ...]
    points: dict[str, tuple[Points, ...]]
    surfaces: dict[str, np.ndarray]
    unusual: list[str]


def _reduce(published: Urdf, wish: Wish, folder: Path) -> _Reduced:
    """Return a URDF reduced to the hand below the root that was asked for; `folder` has meshes."""
    # frames are merged twice: a wrist that is fixed leaves new ones
    urdf, below = keep_below(published, wish.root or published.root)
    urdf, merged, taken = merge_frames(urdf)
    urdf, fixed = fix_wrist(urdf, fingertip_links(urdf) or [urdf.root])
    urdf, merged_again, taken_again = merge_frames(urdf)
    points = shape_points(urdf, folder)
    surfaces = {name: np.concatenate(parts) for name, parts in points.items() if parts}
    urdf, marked, taken_markers = merge_markers(urdf, surfaces)
    unusual = list(find_unusual(urdf, points))
    urdf, joints = repair_joints(urdf)
    urdf, bodies = repair_bodies(urdf, surfaces)
    repairs = [*below, *merged, *fixed, *merged_again, *marked, *joints, *bodies]
    mergers = taken, taken_again, taken_markers
    return _Reduced(urdf, repairs, mergers, points, surfaces, unusual)


def _tips(reduced: _Reduced, wish: Wish, origin: FromMjcf | None) -> tuple[str, ...]:
    """Return the links of the fingertips that the user or the MJCF names; empty if none."""
    tips = tuple(wish.tips or (origin.tips if origin else ()))
    # a tip that the user named may have been merged into another link
    for merger in reduced.mergers:
        tips = tuple(merger.get(tip, tip) for tip in tips)
    if not wish.tips and not set(tips) <= {x.name for x in reduced.urdf.links if x.shapes}:
        # sites of what was cut off
        return ()
    return tips


def _round_tips(
    urdf: Urdf, clean: Urdf, tips: Sequence[str], guess: Guess, surfaces: dict[str, np.ndarray]
) -> tuple[Urdf, list[str]]:
    """Return the `clean` URDF with a ball in each tip of no simple shape in `urdf`. Return also a
    sentence on these tips, if any.
    """
    simple = {x.name for x in urdf.links if is_primitive(x)}
    balls = list[str]()
    for tip, pad, outward in zip(tips, guess.pads, guess.outward, strict=True):
        if tip not in simple:
            balls.append(f"{tip} {1e3 * pad.radius:.1f} mm")
            clean = ball_tip(clean, tip, pad, outward, surfaces[tip])
    if not balls:
        return clean, []
    return clean, [f"fingertips touch with a ball in their end, of radius: {', '.join(balls)}"]


def _bare_links(urdf: Urdf, visual: bool) -> tuple[str, ...]:
    """Return the links with a <visual> but no <collision>.

    Raises `HandFileError` if no link has a collision shape, which names what `visual` would take.
    """
    bare = seen_links(urdf.data)
    if any(x.shapes for x in urdf.links):
        return bare
    allowed = "links with a <collision>, or with a <visual> and --visual"
    if bare and not visual:
        allowed = f"links with a <collision>; --visual takes the <visual> of {len(bare)} links"
    raise urdf.wrong("no link with a <collision>", allowed)


def _thin_tips(tips: tuple[str, ...], surfaces: dict[str, np.ndarray]) -> list[str]:
    """Return a warning, or none, that names the fingertips that are thinner than fingers are.

    `surfaces` holds points (n, 3) [m] on each link, by its name.
    """
    thick = {tip: float(np.ptp(surfaces[tip], axis=0).min()) for tip in tips}
    thin = [f"{tip} {1e3 * size:.1f} mm" for tip, size in thick.items() if size < DRAFT.thin]
    if not thin:
        return []
    sizes = ", ".join(thin)
    return [f"fingertips are thinner than fingers, are they others (--tips)? {sizes}"]


def _mixed_joints(urdf: Urdf) -> list[str]:
    """Return a warning, or none, that names the sliding joints of a hand whose other joints turn."""
    free = [j for j in urdf.movable if j.mimic is None]
    slides = [j.name for j in free if j.kind == "prismatic"]
    if not slides or len(slides) == len(free):
        return []
    names = ", ".join(slides)
    return [
        f"kp and kd are those of joints that turn; in N/m they are weak for joints that slide: {names}"
    ]


def _part_pairs(
    urdf: Urdf, options: Mapping[str, "FingerSet"], seed: int
) -> tuple[dict[tuple[str, str], float], list[str]]:
    """Return pairs of links, then warnings. A pair to test for collision has 0. A pair that is left
    out has the share of random postures in which it meets.

    Pairs are left out where some option has hardly a free posture with them.
    """
    coupling = _coupling(urdf)
    pairs = collision_pairs(urdf, coupling, seed=seed)
    left_out = {pair: 0.0 for pair in pairs}
    warnings = list[str]()
    for name, option in options.items():
        held = tuple(
            dataclasses.replace(j, lower=option.parked[j.name], upper=option.parked[j.name])
            if j.name in option.parked
            else j
            for j in urdf.joints
        )
        still = dataclasses.replace(urdf, joints=held)
        met = met_pairs(still, pairs, draw_postures(still, coupling, DRAFT.trials, seed))  # (p, n)
        shares = dict(zip(pairs, met.double().mean(1).tolist(), strict=True))
        if float((~met.any(0)).double().mean()) >= DRAFT.least_free:
            continue
        for (one, two), share in shares.items():
            within = _hangs_on(urdf, one, two) or _hangs_on(urdf, two, one)
            if share >= (DRAFT.most_within if within else DRAFT.most_between):
                left_out[one, two] = max(left_out[one, two], share)
        kept = torch.tensor([not left_out[pair] for pair in pairs])
        free = float((~met[kept].any(0)).double().mean())
        if free < DRAFT.least_free:
            others = [pair for pair in pairs if not left_out[pair]]
            often = sorted(others, key=lambda pair: -shares[pair])[: DRAFT.listed]
            listed = ", ".join(f"{one} and {two} {shares[one, two]:.0%}" for one, two in often)
            warnings.append(
                f"only {free:.1%} of random postures of option {name} are free. Most often meet "
                f"{listed}: make their collision shapes smaller, or take pairs out"
            )
    out = {pair: share for pair, share in left_out.items() if share}
    if out:
        listed = ", ".join(f"{one} and {two} {share:.0%}" for (one, two), share in out.items())
        warnings.insert(
            0,
            "pairs of links that leave no posture free are left out of [self_collision]. "
            f"They meet in these shares of random postures: {listed}",
        )
    return left_out, warnings


def _hangs_on(urdf: Urdf, link: str, other: str) -> bool:
    """Return whether a link is another one or below it."""
    return link == other or any(j.parent == other for j in urdf.joints_above(link))


@checked
def clean_arm(path: Path | str, meshes: Path | str | None = None) -> str:
    """Return the text of an arm's URDF with boxes and cylinders in place of collision meshes.

    `load_arm` reads only URDFs without meshes. A revolute joint without limits gets [-pi, pi] rad.
    A joint without a limit of effort or velocity gets one that is typical of small hands.

    Args:
        path: the published URDF of the arm.
        meshes: folder in which all mesh files lie; None means the folder of the URDF.

    Raises `HandFileError` for a URDF or a mesh that is missing, malformed, too large or outside its
    folder. It is also raised for a sliding joint without limits.

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


class FingerSet(NamedTuple):
    """A set of fingers that grasp, and the positions of the joints that stay fixed meanwhile.

    `tips` are the names of the fingertip links that grasp. `parked` holds the position [rad or m]
    of each fixed joint, by the joint's name.
    """

    tips: list[str]
    parked: dict[str, float]


def _options(urdf: Urdf, sets: Mapping[str, list[str]]) -> dict[str, FingerSet]:
    """Return the options of a hand, by name, for sets of fingertip links."""
    options = {}
    for name, grasping in sets.items():
        joints = {j.name for tip in grasping for j in urdf.movers(tip)}
        options[name] = FingerSet(grasping, _parked(urdf, joints))
    return options


def _checked_tips(urdf: Urdf, tips: tuple[str, ...], bare: tuple[str, ...]) -> tuple[str, ...]:
    """Return the given fingertip links, else those found; raise `BadArgument` if their number or a
    link is unusable.

    `bare` are links without collision shapes that the error names.
    """
    ends = fingertip_links(urdf)
    chosen = tips or ends
    if not FINGERTIPS[0] <= len(chosen) <= FINGERTIPS[1] or len(set(chosen)) < len(chosen):
        wanted = (
            "three to five different links in grasp order; "
            f"the branches of {urdf.path} end in {list(ends)}"
        )
        if len(ends) > FINGERTIPS[1]:
            wanted += "; --root chooses one of several hands"
        if bare:
            wanted += f"; --visual takes the <visual> of links without <collision>: {list(bare)}"
        raise BadArgument("tips", list(tips) or f"a hand of {len(ends)} fingers", wanted)
    shaped = {x.name for x in urdf.links if x.shapes}
    for tip in chosen:
        if tip not in shaped or not urdf.movers(tip):
            wanted = f"links with a collision shape that joints move, such as {list(ends)}"
            raise BadArgument("tips", tip, wanted)
    for one, two in () if tips else itertools.combinations(chosen, 2):
        if urdf.movers(one) == urdf.movers(two):
            found = f"{one} and {two}, two ends of one finger"
            allowed = f"three to five of {list(ends)}, one of each finger"
            raise BadArgument("tips", found, allowed)
    return chosen


def _coupling(urdf: Urdf) -> dict[str, Mimic]:
    return {j.name: j.mimic for j in urdf.movable if j.mimic is not None}


def _gains(urdf: Urdf) -> tuple[float, float]:
    """Return stiffness [N m/rad] and damping [N m s/rad] for the drives, similar to those of the
    shipped hands.

    They are in [N/m] and [N s/m] if all independent joints slide.
    """
    free = [j for j in urdf.movable if j.mimic is None]
    turning = [j for j in free if j.kind != "prismatic"]
    kp = min(DRAFT.slide_stiffness * min(j.effort for j in free), DRAFT.most_slide_stiffness)
    if turning:
        kp = min(DRAFT.stiffness * min(j.effort for j in turning), DRAFT.most_stiffness)
    zero = torch.zeros(1, len(urdf.movable), dtype=torch.float64)
    poses = tree_from_urdf(urdf).poses(zero)[0].numpy()  # (l, 4, 4)
    names = [x.name for x in urdf.links]
    placed = zip(poses, urdf.links, strict=True)
    centres = np.array([pose[:3, :3] @ x.com + pose[:3, 3] for pose, x in placed])
    # greatest inertia that a joint turns, of all links beyond it as points; or mass that one slides
    heaviest = 0.0
    for j in turning or free:
        pose = poses[names.index(j.child)]
        moved = [k for k, name in enumerate(names) if j in urdf.joints_above(name)]
        arms = np.cross(pose[:3, :3] @ j.axis, centres[moved] - pose[:3, 3])
        weights = (arms**2).sum(1) if turning else np.ones(len(moved))
        masses = np.array([urdf.links[k].mass for k in moved])
        heaviest = max(heaviest, float(masses @ weights))
    critical = 2 * np.sqrt(kp * (heaviest + DRAFT.rotor))
    return kp, max(DRAFT.damping * kp, critical)


def _toml_text(
    urdf: Urdf,
    name: str,
    file: str,
    pads: dict[str, Pad],
    options: Mapping[str, FingerSet],
    approach: Triple,
    pairs: Mapping[tuple[str, str], float],
    warnings: Sequence[str],
) -> str:
    """Return the text of a hand.toml: `name` is that of the hand, `file` that of the URDF.

    `pads` are given by tip, and `options` by name. `pairs` of links have the share with which each
    is left out.
    """
    kp, kd = _gains(urdf)
    return _render(
        "hand.toml",
        name=name,
        file=file,
        urdf=urdf,
        approach=approach,
        kp=kp,
        kd=kd,
        slides=all(j.kind == "prismatic" for j in urdf.movable if j.mimic is None),
        coupling=_coupling(urdf),
        options=options,
        pads=pads,
        names={tip: tip.removesuffix("_tip") for tip in pads},
        chains={tip: [j.name for j in urdf.movers(tip)[::-1]] for tip in pads},
        pairs=pairs,
        warnings=warnings,
    )


def _urdf_text(urdf: Urdf, visuals: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return the text of a clean URDF, with the file of the visual mesh of each link in `visuals`."""
    return _render("hand.urdf", urdf=urdf, sizes=SIZES, visuals=visuals)


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
    moved = grasping | leading(coupling, grasping)
    return {j.name: j.rest for j in urdf.movable if j.name not in coupling and j.name not in moved}


def fingertip_links(urdf: Urdf) -> tuple[str, ...]:
    """Return the names of the fingertip links of a URDF.

    Each is the last link with a collision shape on a branch, if a joint moves this link.
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
