"""From a hand's folder to the hand: find it, read its two files, and refuse them where they do not fit each other."""

import hashlib
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import HandFileError
from torchgrasp.hand.collision_spheres import spheres_from_urdf
from torchgrasp.hand.hand import Actuator, Hand
from torchgrasp.hand.hand_toml import HandSpec, read_hand_toml
from torchgrasp.hand.kinematics import ancestor_mask, fixed_to, kinematics_from_urdf
from torchgrasp.hand.self_collision import self_collision_from_urdf
from torchgrasp.hand.urdf import Urdf, read_urdf


def hands_folder() -> Path:
    """Return the folder of the shipped hands: inside the installed package, else beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "assets" / "hands"
    return installed if installed.is_dir() else package.parent / "hands"


def find_hand(name_or_path: str | Path) -> Path:
    """Return the folder of a shipped hand by its name, or of a hand's folder or hand.toml by its path.

    Raises:
        HandFileError: there is no such hand; the message lists the shipped ones.
    """
    shipped = hands_folder()
    names = sorted(p.parent.name for p in shipped.glob("*/hand.toml"))
    if isinstance(name_or_path, str) and name_or_path in names:
        return shipped / name_or_path
    path = Path(name_or_path)
    folder = path.parent if path.name == "hand.toml" else path
    if not (folder / "hand.toml").is_file():
        raise HandFileError("hand", f"{str(name_or_path)!r}", f"one of {names}, or a folder with a hand.toml")
    return folder


def load_hand(name_or_path: str | Path, fingers: str = "default") -> Hand:
    """Load a hand from its hand.toml and URDF, with one of the finger options that its hand.toml offers.

    Args:
        name_or_path: a shipped hand ("allegro", "allegro_biotac", "barrett"), or the folder of another one.
        fingers: "default", or for the Allegro "paper_literal" (index, middle and ring finger).

    Raises:
        HandFileError: a file is missing, malformed, or the two do not fit each other.
        BadArgument: the hand has no such option.

    >>> load_hand("barrett").joint_names
    ('spread', 'f1_flex', 'f2_flex', 'f3_flex')
    """
    spec = read_hand_toml(find_hand(name_or_path) / "hand.toml", fingers)
    return hand_from_files(spec, read_urdf(spec.urdf))


def hand_from_files(spec: HandSpec, urdf: Urdf) -> Hand:
    """Assemble a hand from its two files, checking that they fit each other.

    Raises:
        HandFileError: hand.toml names what the URDF does not have, a joint neither grasps nor is parked, a margin
            leaves no range, or links without a collision shape.
    """
    movable = {j.name: j for j in urdf.joints if j.kind != "fixed"}
    links = {x.name: i for i, x in enumerate(urdf.links)}
    _check_names(spec, urdf, set(movable), set(links))
    _check_coupling(spec, urdf)
    _check_shapes(spec, urdf)
    names = tuple(dict.fromkeys(j for f in spec.fingers for j in f.joints if j not in spec.coupling))
    coupling, offset = _coupling(spec, tuple(movable), names)
    limits = torch.tensor([[movable[n].lower, movable[n].upper] for n in names], dtype=torch.float64)
    limits = limits + torch.tensor([spec.limit_margin, -spec.limit_margin], dtype=torch.float64)
    for name, (low, high) in zip(names, limits.tolist(), strict=True):
        if not low < high:
            found = f"{spec.path}: limit_margin {spec.limit_margin:g} leaves joint {name} [{low:g}, {high:g}]"
            raise HandFileError("hand.toml", found, "lower < upper")
    kinematics = kinematics_from_urdf(urdf)
    carriers, poses = zip(*(fixed_to(urdf, f.tip_link) for f in spec.fingers), strict=True)
    leading = kinematics_from_urdf(urdf, carriers)
    fingers = spec.fingers
    return Hand(
        name=spec.name,
        option=spec.option,
        urdf_path=urdf.path,
        sha256=hashlib.sha256(spec.data + b"\0" + urdf.data).hexdigest(),
        joint_names=names,
        lower=limits[:, 0].clone(),
        upper=limits[:, 1].clone(),
        finger_names=(fingers[0].name, fingers[1].name, fingers[2].name),
        tip_links=(fingers[0].tip_link, fingers[1].tip_link, fingers[2].tip_link),
        urdf_joint_names=kinematics.joint_names,
        link_names=kinematics.link_names,
        coupling=coupling,
        offset=offset,
        approach=torch.tensor(spec.approach, dtype=torch.float64),
        tip_index=torch.tensor([links[f.tip_link] for f in fingers]),
        contact=torch.tensor([f.contact for f in fingers], dtype=torch.float64),
        normal=torch.tensor([f.normal for f in fingers], dtype=torch.float64),
        center=torch.tensor([f.center for f in fingers], dtype=torch.float64),
        tip_radius=torch.tensor([f.radius for f in fingers], dtype=torch.float64),
        axis=torch.tensor([j.axis for j in movable.values()], dtype=torch.float64),
        prismatic=torch.tensor([float(j.kind == "prismatic") for j in movable.values()], dtype=torch.float64),
        child=kinematics.child,
        moves=torch.tensor(ancestor_mask(urdf), dtype=torch.float64),
        actuators={n: Actuator(j.effort, j.velocity, spec.kp, spec.kd) for n, j in movable.items()},
        collision_spheres=spheres_from_urdf(urdf, spec),
        self_collision=self_collision_from_urdf(urdf, spec.pairs),
        tip_place=torch.tensor([leading.link_names.index(name) for name in carriers]),
        tip_pose=torch.stack(poses, -1)[..., None],
        kinematics=kinematics,
        fingers=leading,
    )


def _coupling(
    spec: HandSpec, movable: tuple[str, ...], names: tuple[str, ...]
) -> tuple[Float[Tensor, "j h"], Float[Tensor, " j"]]:
    """Return the matrix and offset that give every joint from the actuated ones."""
    matrix = torch.zeros(len(movable), len(names), dtype=torch.float64)
    offset = torch.zeros(len(movable), dtype=torch.float64)
    for row, joint in enumerate(movable):
        source, ratio, shift = spec.coupling.get(joint, (joint, 1.0, 0.0))
        if source in names:
            matrix[row, names.index(source)] = ratio
            offset[row] = shift
        elif source in spec.parked:
            offset[row] = ratio * spec.parked[source] + shift
        else:
            raise HandFileError("hand.toml", f"{spec.path}: joint {joint} neither grasps nor is parked", "either")
    return matrix, offset


def _check_names(spec: HandSpec, urdf: Urdf, movable: set[str], links: set[str]) -> None:
    """Refuse names in hand.toml that the URDF does not have."""
    if spec.base_link != urdf.root:
        raise HandFileError("hand.toml", f"{spec.path}: base_link {spec.base_link!r}", f"the URDF's root {urdf.root!r}")
    joints = [j for f in spec.all_fingers for j in f.joints] + list(spec.parked) + list(spec.coupling)
    joints += [source for source, _, _ in spec.coupling.values()]
    named = [f.tip_link for f in spec.all_fingers] + [x for pair in spec.pairs or () for x in pair]
    for kind, found, known in (("joint", joints, movable), ("link", named, links)):
        unknown = sorted(set(found) - known)
        if unknown:
            raise HandFileError("hand.toml", f"{spec.path}: {kind} {unknown[0]!r}", f"one of {sorted(known)}")
    grasping = {j for f in spec.fingers for j in f.joints}
    moved = grasping | {source for joint, (source, _, _) in spec.coupling.items() if joint in grasping}
    both = sorted(set(spec.parked) & (moved | set(spec.coupling)))
    if both:
        allowed = "joints that neither grasp nor follow another"
        raise HandFileError("hand.toml", f"{spec.path}: parked joint {both[0]!r}", allowed)


def _check_coupling(spec: HandSpec, urdf: Urdf) -> None:
    """Refuse a joint that follows another in the URDF and is free, or follows otherwise, in hand.toml."""
    for joint in urdf.joints:
        if joint.mimic is not None and spec.coupling.get(joint.name) != joint.mimic:
            found = f"{spec.path}: joint {joint.name} follows {spec.coupling.get(joint.name, 'nothing')}"
            raise HandFileError("hand.toml", found, f"the coupling of the URDF: {joint.mimic}")


def _check_shapes(spec: HandSpec, urdf: Urdf) -> None:
    """Refuse a hand whose fingertips or whose other links no collision check and no simulator could see."""
    tips = {f.tip_link for f in spec.fingers}
    bare = sorted(x.name for x in urdf.links if x.name in tips and not x.shapes)
    if bare:
        raise HandFileError("urdf", f"{urdf.path}: link {bare[0]} without collision", "a shape for every fingertip")
    if not any(x.shapes for x in urdf.links if x.name not in tips):
        raise HandFileError("urdf", f"{urdf.path}: collision of fingertips alone", "shapes for palm and fingers too")
