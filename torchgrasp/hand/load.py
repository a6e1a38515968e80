"""Loading of a hand from its folder; checks that hand.toml and URDF agree."""

import hashlib
from pathlib import Path

import torch

from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, HandFileError
from torchgrasp.foundation.limits import HAND_LINK_MASS
from torchgrasp.geometry.frames import real
from torchgrasp.hand.collision_shapes import self_collision_from_urdf, spheres_from_urdf
from torchgrasp.hand.fingers import joints_from_files, tips_from_files
from torchgrasp.hand.hand import Actuator, Hand, HandSource
from torchgrasp.hand.hand_toml import Fingers, HandSpec, leading, read_hand_toml
from torchgrasp.hand.kinematics import chain_from_urdf, tree_from_urdf
from torchgrasp.hand.urdf import Urdf, read_urdf
from torchgrasp.values.planning import Grasps

ROUNDING = 1e-6  # greatest difference of a hand's numbers, absolute and relative: that of float32


def hands_folder() -> Path:
    """Return the folder of the shipped hands.

    It is inside the package, or beside the package in a source checkout.

    >>> (hands_folder() / "allegro" / "hand.toml").is_file()
    True
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "assets" / "hands"
    return installed if installed.is_dir() else package.parent / "hands"


def list_hands() -> tuple[str, ...]:
    """Return the names of the shipped hands, in alphabetical order.

    >>> "allegro" in list_hands()
    True
    """
    return tuple(sorted(path.parent.name for path in hands_folder().glob("*/hand.toml")))


@checked
def find_hand(name_or_path: str | Path) -> Path:
    """Return the folder of a hand.

    Args:
        name_or_path: name of a shipped hand, a folder with a hand.toml, or the path of a hand.toml.

    Raises `HandFileError` if there is no such hand. It is also raised if a folder in the working
    directory has a shipped hand's name and a hand.toml. "./NAME" means that folder.

    >>> find_hand("allegro").name
    'allegro'
    """
    shipped = hands_folder()
    names = list(list_hands())
    if isinstance(name_or_path, str) and name_or_path in names:
        here = Path(name_or_path)
        if (here / "hand.toml").is_file() and here.resolve() != (shipped / name_or_path).resolve():
            found = f"{name_or_path!r}, which is a shipped hand and a folder here"
            raise HandFileError(
                "hand", found, f"'./{name_or_path}' for the folder, or a folder of another name"
            )
        return shipped / name_or_path
    path = Path(name_or_path)
    folder = path.parent if path.name == "hand.toml" else path
    if not (folder / "hand.toml").is_file():
        raise HandFileError(
            "hand", f"{str(name_or_path)!r}", f"one of {names}, or a folder with a hand.toml"
        )
    return folder


@checked
def load_hand(name_or_path: str | Path, fingers: Fingers = "default") -> Hand:
    """Load a hand from its hand.toml and URDF, with the chosen grasping fingers.

    Args:
        name_or_path: name of a shipped hand, such as "allegro", "barrett", "leap" or "shadow". Or
            the folder or hand.toml of another hand.
        fingers: the grasping fingers, in one of these forms:
            - the name of an option of hand.toml, which lists fingers: "default". For the Allegro
              hand also "four" (all) or "paper_literal" (index, middle and ring);
            - a number of fingers, for the first option with this number;
            - a tuple of the names of three to five fingers, or a text with commas:
              "index,middle,thumb".

    An option gives a fixed position to each joint that neither grasps nor follows another joint.
    Fingers chosen by their names may leave joints without such a position. These joints stay at
    zero, or at the limit nearest to zero.

    Raises:
        HandFileError: a file is missing or malformed, or the two files contradict each other.
        BadArgument: the hand has no such fingers.

    >>> load_hand("allegro", ("index", "ring", "thumb")).finger_names
    ('index', 'ring', 'thumb')
    """
    spec = read_hand_toml(find_hand(name_or_path) / "hand.toml", fingers)
    urdf = read_urdf(spec.urdf)
    _check_names(spec, urdf)
    _check_mimics_and_shapes(spec, urdf)
    _check_masses(urdf)
    chain = chain_from_urdf(urdf)
    digest = hashlib.sha256(spec.data + b"\0" + urdf.data).hexdigest()
    return Hand(
        name=spec.name,
        source=HandSource(spec.option, urdf.path, digest, tuple(spec.options)),
        actuated=joints_from_files(spec, urdf),
        chain=chain,
        tree=tree_from_urdf(urdf, chain),
        tips=tips_from_files(spec, urdf, chain),
        approach=real(spec.approach),
        actuators={j.name: Actuator(j.effort, j.velocity, spec.kp, spec.kd) for j in urdf.movable},
        collision_spheres=spheres_from_urdf(urdf, spec),
        self_collision=self_collision_from_urdf(urdf, spec.pairs),
    )


@checked
def with_fingers(hand: Hand, fingers: Fingers) -> Hand:
    """Return the same hand, on the same device, with other grasping fingers.

    The hand's files are read again. A hand that already has these fingers is returned as it is.
    For an option, or a number, its other joints must also be where the option parks them.

    Args:
        hand: the hand.
        fingers: the grasping fingers, as in `load_hand`: an option's name, a number, or names.

    Raises:
        HandFileError: a file is missing or malformed, or the two files contradict each other.
        BadArgument: the hand has no such fingers, or other numbers than its files.

    >>> with_fingers(load_hand("allegro"), 4).finger_names
    ('index', 'middle', 'ring', 'thumb')
    """
    other = load_hand(hand.urdf_path.parent, fingers)
    if other.finger_names == hand.finger_names:
        own = hand.actuated.offset.to("cpu")
        parked = other.source.option == hand.source.option or _agree(own, other.actuated.offset)
        if parked or _are_names(fingers, hand):
            return hand
    check_as_loaded(hand)
    return other.to(hand.lower)


def _are_names(fingers: Fingers, hand: Hand) -> bool:
    """Return whether `fingers` are names of the hand's fingers: no option of hand.toml, no number."""
    if isinstance(fingers, str) and fingers not in hand.source.options:
        return tuple(fingers.split(",")) == hand.finger_names
    return fingers == hand.finger_names


def check_as_loaded(hand: Hand) -> None:
    """Raise `BadArgument` for a hand with other numbers than its files, such as narrower limits.

    Functions that read the hand's files again call it, because they would not use such numbers.
    """
    loaded = load_hand(hand.urdf_path.parent, hand.source.option)
    ours = named_tensors(hand.to("cpu", torch.float64))
    theirs = named_tensors(loaded)
    same = loaded.source.sha256 == hand.source.sha256
    same = same and loaded.actuators == hand.actuators and ours.keys() == theirs.keys()
    if not same or not all(_agree(ours[name], theirs[name]) for name in theirs):
        found = f"one of {hand.name} that is not as in {hand.urdf_path.parent}"
        allowed = "a hand as load_hand returns it: it is read again here, so change its files"
        raise BadArgument("hand", found, allowed)


def _agree(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Return whether two tensors have one shape, and equal numbers but for the rounding of
    float32.
    """
    if one.shape != other.shape:
        return False
    return torch.allclose(one.double(), other.double(), rtol=ROUNDING, atol=ROUNDING)


@checked
def hand_of(grasps: Grasps, hand: Hand | str | Path | None = None) -> Hand:
    """Return the hand of given grasps, with the fingers for which they were planned.

    Args:
        grasps: grasps of `plan_grasps`, or loaded from a file. Their `meta` names hand and fingers.
        hand: the same hand with any fingers, its name or its folder. None means the hand that
            the grasps name: a shipped one, or a folder in the working directory.

    Raises:
        HandFileError: a file of the hand is missing or malformed, or its files contradict each
            other.
        BadArgument: the grasps name no hand, another hand, or fingers that the hand lacks.

    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> hand_of(load_shipped_grasp("jug", "barrett")).name
    'barrett'
    """
    name = grasps.meta.get("hand")
    names = grasps.meta.get("finger_names")
    if name is None:
        raise BadArgument("grasps", "grasps without a hand in `meta`", "grasps of plan_grasps")
    fingers = "default" if names is None else tuple(names.split(","))
    known = hand
    if hand is None:
        known = load_hand(name, fingers)
    elif not isinstance(hand, Hand):
        known = load_hand(hand)  # its own fingers: another hand has not those of the grasps
    assert isinstance(known, Hand)
    if known.name != name:
        raise BadArgument("hand", known.name, f"{name}, for which the grasps were planned")
    return known if hand is None else with_fingers(known, fingers)


def check_named(hand: Hand, grasps: Grasps) -> None:
    """Raise `BadArgument` for a hand of another name, or of other fingers, than the grasps name. The
    joints of one finger would move another.
    """
    ours = {"hand": hand.name, "finger_names": ",".join(hand.finger_names)}
    for name, own in ours.items():
        planned = grasps.meta.get(name, own)
        if planned != own:
            allowed = f"{planned}, as the grasps name: `hand_of(grasps)` loads it"
            raise BadArgument("hand", own, allowed)


def _check_names(spec: HandSpec, urdf: Urdf) -> None:
    """Raise `HandFileError` for names that the URDF lacks, and for parked joints that also grasp or
    are coupled.
    """
    movable = {j.name for j in urdf.movable}
    links = {x.name for x in urdf.links}
    if spec.base_link != urdf.root:
        raise spec.wrong(
            f"base_link {spec.base_link!r}", f"the URDF's root {urdf.root!r} as base_link"
        )
    leaders = leading(spec.coupling, spec.coupling)
    joints = {j for f in spec.all_fingers for j in f.joints} | {
        *spec.parked,
        *spec.coupling,
        *leaders,
    }
    named = {f.tip_link for f in spec.all_fingers} | {x for pair in spec.pairs or () for x in pair}
    for kind, unknown, known in (
        ("joint", joints - movable, movable),
        ("link", named - links, links),
    ):
        if unknown:
            raise spec.wrong(f"{kind} {min(unknown)!r}", f"one of {sorted(known)}")
    grasping = {j for f in spec.fingers for j in f.joints}
    moved = grasping | leading(spec.coupling, grasping)
    both = set(spec.parked) & (moved | set(spec.coupling))
    if both:
        raise spec.wrong(
            f"parked joint {min(both)!r}",
            "parked joints that neither grasp nor follow another joint",
        )


def _check_masses(urdf: Urdf) -> None:
    """Raise `HandFileError` for a link that is too heavy for a hand, as one in grams."""
    for link in urdf.links:
        if not link.mass <= HAND_LINK_MASS:
            found = f"link {link.name} of {link.mass:g} kg"
            raise urdf.wrong(found, f"masses in kg, at most {HAND_LINK_MASS:g} (in grams?)")


def _check_mimics_and_shapes(spec: HandSpec, urdf: Urdf) -> None:
    """Raise `HandFileError` for couplings that contradict the URDF, and for missing collision
    shapes.

    Every fingertip needs a shape, and so does at least one other link.
    """
    for joint in urdf.joints:
        if joint.mimic is not None and spec.coupling.get(joint.name) != joint.mimic:
            found = f"joint {joint.name} follows {spec.coupling.get(joint.name, 'nothing')}"
            raise spec.wrong(found, f"the coupling of the URDF: {joint.mimic}")
    tips = {f.tip_link for f in spec.fingers}
    bare = {x.name for x in urdf.links if not x.shapes}
    if tips & bare:
        raise urdf.wrong(
            f"link {min(tips & bare)} without collision shapes",
            "a collision shape for every fingertip",
        )
    if len(tips | bare) == len(urdf.links):
        raise urdf.wrong("collision shapes of fingertips alone", "shapes for palm and fingers, too")
