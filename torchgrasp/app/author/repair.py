"""Repair of published URDFs: massless frames, wrists, masses, limits, coupled joints.

Every step returns the repaired URDF and a sentence for each repair.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.hand.urdf import Joint, Link, Mimic, Triple, Urdf, pose_of


@dataclasses.dataclass(frozen=True)
class RepairNumbers:
    """Numbers that a URDF gets where it lacks them, and bounds of what is possible."""

    # greatest torque [N m] of a turning joint whose drive the URDF does not declare, typical of
    # small hands
    effort: float = 1.0
    velocity: float = 3.0  # greatest speed [rad/s] of such a joint
    # greatest force [N] of a sliding joint whose drive the URDF does not declare. It presses as
    # that torque does at a finger of 0.1 m.
    force: float = 10.0
    speed: float = 0.1  # greatest speed [m/s] of such a sliding joint, as of grippers
    most_wrist: int = 3  # greatest number of joints that move all fingertips: more are an arm
    # mass [kg] up to which a link without shapes is only a frame: exporters write 1e-9 where a mass
    # is needed
    frame: float = 1e-5
    # size [m] below which a fixed end link is a marker: no fingertip is so small
    marker: float = 6e-3
    # least mass [kg] given to a body without mass, so that simulators remain stable
    least_mass: float = 1e-3
    least_size: float = 5e-3  # least edge [m] of the box of such a body, for the same reason
    # density [kg/m3] of the bounding box of a body without mass: half of it is filled with 1000
    # kg/m3
    density: float = 500.0
    # greatest distance of a link's mass centre from the middle of its bounding box, and greatest
    # radius of gyration, in half diagonals of this box
    far_out: float = 2.0
    rounding: float = 1e-6  # relative error of inertias, which URDFs write with few digits
    digits: int = 15  # number of decimals of an angle [rad], so that short numbers remain short


REPAIRS = RepairNumbers()
BOX = 12  # divisor in the inertia of a solid box
Step = tuple[Urdf, list[str]]  # the repaired URDF, and a report: a sentence for each repair


def place(pose: np.ndarray) -> tuple[Triple, Triple]:
    """Return translation [m] and fixed-axis angles (roll, pitch, yaw) [rad] of a pose (4, 4).

    A URDF writes the <origin> of a joint or shape in this way.
    """
    # of the two triples that mean the same rotation, the smaller
    one = [float(angle) for angle in trimesh.transformations.euler_from_matrix(pose)]
    two = [math.copysign(math.pi, angle) - angle for angle in one]
    angles = min((one, (-two[0], two[1], -two[2])), key=lambda triple: sum(map(abs, triple)))
    rounded = [round(angle, REPAIRS.digits) for angle in angles]
    # the sum has no negative zero
    x, y, z, roll, pitch, yaw = (float(number) + 0.0 for number in [*pose[:3, 3], *rounded])
    return (x, y, z), (roll, pitch, yaw)


def keep_below(urdf: Urdf, root: str) -> Step:
    """Return the URDF with only the link `root` and the links below it, and a sentence on it.

    This cuts a hand off an arm. The sentence is the only one in a list, which is empty if `root` is
    the first link already. Raises `BadArgument` for an unknown root, and `HandFileError` for a
    joint that mimics one above the root.
    """
    names = {x.name for x in urdf.links}
    if root not in names:
        raise BadArgument("root", repr(root), f"a link of {urdf.path}: {sorted(names)}")
    if root == urdf.root:
        return urdf, []
    kept = {x for x in names if x == root or any(j.parent == root for j in urdf.joints_above(x))}
    joints = tuple(j for j in urdf.joints if j.parent in kept)
    inside = {j.name for j in joints}
    for j in joints:
        outside = [name for name, _ in j.mimic.terms if name not in inside] if j.mimic else []
        if outside:
            found = f"joint {j.name} that follows {outside[0]!r} above {root!r}"
            raise urdf.wrong(found, "a root above both")
    links = tuple(x for x in urdf.links if x.name in kept)
    done = f"{len(names) - len(kept)} links that are not below {root} are left out"
    return dataclasses.replace(urdf, root=root, links=links, joints=joints), [done]


def merge_frames(urdf: Urdf) -> tuple[Urdf, list[str], dict[str, str]]:
    """Return the URDF with massless links merged into the links to which they are fixed.

    A link without shapes counts as massless up to 1e-5 kg (`REPAIRS.frame`). A massless link at the
    end of a branch is kept if it has shapes. The second result is a list of one sentence on the
    merged links, empty without any. The third gives, by the name of each merged link, the name of
    the link that took it over.
    """
    taken: dict[str, str] = {}
    while True:
        links = {x.name: x for x in urdf.links}
        parents = {j.parent for j in urdf.joints}
        for j in (j for j in urdf.joints if j.kind == "fixed"):
            child = links[j.child]
            parent = links[j.parent]
            bare_root = j.parent == urdf.root and _is_bare(parent)
            frame = _is_bare(child) or (not child.mass > 0 and j.child in parents)
            if frame or bare_root:
                break
        else:
            done = f"frames without mass are merged into others: {', '.join(taken)}"
            return urdf, [done] if taken else [], taken
        moved = _moved(child, pose_of(j))
        # a root without mass and shapes takes over those of its child
        heavy = moved if bare_root else parent
        shapes = parent.shapes + moved.shapes
        merged = dataclasses.replace(heavy, name=parent.name, shapes=shapes)
        urdf, taken = _merge(urdf, j, merged, taken)


def _is_bare(link: Link) -> bool:
    """Return whether a link is a frame alone, without shapes and with hardly any mass."""
    return not link.shapes and not link.mass > REPAIRS.frame


def merge_markers(
    urdf: Urdf, surfaces: Mapping[str, np.ndarray]
) -> tuple[Urdf, list[str], dict[str, str]]:
    """Return the URDF with markers at fingertips merged into the links to which they are fixed.

    A marker is a link smaller than 6 mm (`REPAIRS.marker`), too small to touch an object. Some
    hands have markers for calibration. Its mass is kept, and its shapes are left out. `surfaces`
    holds points (n, 3) [m] on each link, by its name, in its frame. The second result is a list of
    one sentence on the markers, empty without any. The third gives, by the name of each marker, the
    name of the link that took it over.
    """
    taken: dict[str, str] = {}
    while marker := _marker(urdf, surfaces):
        (above,) = (j for j in urdf.joints if j.child == marker.name)
        (parent,) = (x for x in urdf.links if x.name == above.parent)
        merged = _heavier(parent, _moved(marker, pose_of(above)))
        urdf, taken = _merge(urdf, above, merged, taken)
    done = [f"{name} into {to}" for name, to in taken.items()]
    most = f"{1e3 * REPAIRS.marker:g} mm"
    told = f"links smaller than {most} at fingertips, markers, are merged: {', '.join(done)}"
    return urdf, [told] if done else [], taken


def _merge(
    urdf: Urdf, joint: Joint, merged: Link, taken: Mapping[str, str]
) -> tuple[Urdf, dict[str, str]]:
    """Return the URDF without a joint and its child, and with `merged` in place of its parent.

    `taken` gives for each link that was merged before the link that took it over. The second result
    adds the child to it.
    """
    parent = joint.parent
    child = joint.child
    others = [j for j in urdf.joints if j is not joint]
    joints = tuple(_under(j, joint) if j.parent == child else j for j in others)
    left = [x for x in urdf.links if x.name != child]
    links = tuple(merged if x.name == parent else x for x in left)
    owners = {name: parent if to == child else to for name, to in taken.items()}
    return dataclasses.replace(urdf, links=links, joints=joints), owners | {child: parent}


def _marker(urdf: Urdf, surfaces: Mapping[str, np.ndarray]) -> Link | None:
    """Return a small link with shapes that is fixed to its parent, and that a joint above moves.
    Below it nothing moves or has shapes. Return None if there is none.
    """
    above = {j.child: j for j in urdf.joints}
    busy = {j.parent for j in urdf.movable} | {
        j.parent for x in urdf.links if x.shapes for j in urdf.joints_above(x.name)
    }
    for link in urdf.links:
        fixed = link.name in above and above[link.name].kind == "fixed"
        if not fixed or not link.shapes or link.name in busy or not urdf.movers(link.name):
            continue
        if float(np.ptp(surfaces[link.name], axis=0).max()) < REPAIRS.marker:
            return link
    return None


def _heavier(link: Link, other: Link) -> Link:
    """Return a link with the mass and inertia of another, in the same frame, added to its own."""
    if not other.mass > 0 or not link.mass > 0:
        return link
    parts = (link, other)
    com = np.average([x.com for x in parts], axis=0, weights=[x.mass for x in parts])
    inertia = np.zeros((3, 3))
    for part in parts:
        arm = np.array(part.com) - com
        inertia += part.inertia_matrix + part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    x, y, z = com.tolist()
    mass = link.mass + other.mass
    return Link(link.name, mass, (x, y, z), _triangle(inertia), link.shapes)


def _under(joint: Joint, above: Joint) -> Joint:
    """Return a joint attached to the parent of a frame that is merged away, with its origin
    adjusted.
    """
    xyz, rpy = place(pose_of(above) @ pose_of(joint))
    return dataclasses.replace(joint, parent=above.parent, xyz=xyz, rpy=rpy)


def _moved(link: Link, pose: np.ndarray) -> Link:
    """Return a copy of a link whose mass centre, inertia and shapes are given in a new frame.

    `pose` (4, 4) [m] is the rigid transform from the link's present frame to the new one.
    """
    turn = pose[:3, :3]
    shapes = []
    for shape in link.shapes:
        xyz, rpy = place(pose @ pose_of(shape))
        shapes.append(dataclasses.replace(shape, xyz=xyz, rpy=rpy))
    x, y, z = (turn @ link.com + pose[:3, 3]).tolist()
    inertia = _triangle(turn @ link.inertia_matrix @ turn.T)
    return Link(link.name, link.mass, (x, y, z), inertia, tuple(shapes))


def fix_wrist(urdf: Urdf, tips: Sequence[str]) -> Step:
    """Return the URDF with the wrist joints fixed at their rest positions, and a sentence on it.

    Wrist joints move all the fingertip links, which `tips` names; with fewer than three tips none
    is sought. More than three wrist joints (`REPAIRS.most_wrist`) are an arm, which is cut off.
    Rest positions are zero, or the limit nearest to zero. The sentence is the only one in a list,
    which is empty if there is no such joint.
    """
    movers = urdf.movers(tips[0]) if len(tips) > 2 else []
    common = [j for j in movers if all(j in urdf.movers(tip) for tip in tips)]
    if len(common) > REPAIRS.most_wrist:
        urdf, done = keep_below(urdf, common[0].child)
        arm = f"{len(common)} joints above {urdf.root} move all fingertips, an arm"
        return urdf, [f"{arm}: {done[0]}"]
    if not common:
        return urdf, []
    # in a chain of followers the file may have any order: each follows its leader directly
    direct = {j.name: j for j in urdf.joints}
    _follow_directly(direct)
    urdf = dataclasses.replace(urdf, joints=tuple(direct.values()))
    at = {j.name: j.rest for j in common}
    # joints that follow a wrist joint are fixed where it puts them
    kept = {}
    for j in urdf.movable:
        if j.mimic and any(name in at for name, _ in j.mimic.terms):
            free = [term for term in j.mimic.terms if term[0] not in at]
            still = {name: at.get(name, 0.0) for name, _ in j.mimic.terms}
            rest = j.mimic.follow(still)
            if free:
                mimic = Mimic(*free[0], rest, tuple(free[1:]))
                kept[j.name] = dataclasses.replace(j, mimic=mimic)
            else:
                at[j.name] = rest
    joints = tuple(
        _fixed(j, at[j.name]) if j.name in at else kept.get(j.name, j) for j in urdf.joints
    )
    places = ", ".join(f"{name} at {value:.4g}" for name, value in at.items())
    done = f"joints that move all fingertips, a wrist, are fixed: {places}"
    return dataclasses.replace(urdf, joints=joints), [done]


def _fixed(joint: Joint, value: float) -> Joint:
    move = trimesh.transformations.translation_matrix(value * np.array(joint.axis))
    if joint.kind != "prismatic":
        move = trimesh.transformations.rotation_matrix(value, joint.axis)
    xyz, rpy = place(pose_of(joint) @ move)
    return Joint(joint.name, "fixed", joint.parent, joint.child, xyz, rpy)


def repair_joints(urdf: Urdf) -> Step:
    """Return the URDF with complete limits of all joints, and a sentence for each repair.

    Missing limits of position, effort and velocity are added, typical of small hands. A follower is
    a joint that mimics another. One that follows a follower then follows an independent joint.
    Ranges of independent joints are narrowed so that their followers keep their own limits. Raises
    `HandFileError` for a sliding joint without limits, and for a follower that cannot keep its
    limits. Raises it also for a follower with a ratio of 0.
    """
    joints = {j.name: j for j in urdf.joints}
    done = (
        _add_limits(urdf, joints)
        + _add_drives(joints)
        + _follow_directly(joints)
        + _limit_leaders(urdf, joints)
    )
    return dataclasses.replace(urdf, joints=tuple(joints.values())), done


def _add_limits(urdf: Urdf, joints: dict[str, Joint]) -> list[str]:
    """Limit endless revolute joints to half a turn either way; raise `HandFileError` for endless
    sliding joints.
    """
    endless = [j for j in urdf.movable if math.isinf(j.upper - j.lower)]
    for j in endless:
        if j.kind == "prismatic":
            wanted = "lower and upper limits of a sliding joint"
            raise urdf.wrong(f"joint {j.name} without a limit", wanted)
        joints[j.name] = dataclasses.replace(j, kind="revolute", lower=-math.pi, upper=math.pi)
    return [
        f"joint {j.name} is continuous or has no limits: they are set to half a turn either way"
        for j in endless
    ]


def _add_drives(joints: dict[str, Joint]) -> list[str]:
    """Give joints without an effort or velocity limit the limits typical of small hands."""
    movable = [j for j in joints.values() if j.kind != "fixed"]
    told = dict[str, list[str]]()
    for j in movable:
        slides = j.kind == "prismatic"
        usual = (REPAIRS.force, REPAIRS.speed) if slides else (REPAIRS.effort, REPAIRS.velocity)
        units = ("N", "m/s") if slides else ("N m", "rad/s")
        effort = j.effort if j.effort > 0 else usual[0]
        velocity = j.velocity if j.velocity > 0 else usual[1]
        joints[j.name] = dataclasses.replace(j, effort=effort, velocity=velocity)
        gets = [f"{effort:g} {units[0]}"] if effort != j.effort else []
        gets += [f"{velocity:g} {units[1]}"] if velocity != j.velocity else []
        if gets:
            told.setdefault(", ".join(gets), []).append(j.name)
    return [
        f"{', '.join(names)} without effort or velocity get {drive}"
        for drive, names in told.items()
    ]


def _follow_directly(joints: dict[str, Joint]) -> list[str]:
    """Make joints coupled to a coupled joint follow the independent joint at the start of the
    chain.
    """
    done = []
    for name, j in joints.items():
        mimic = j.mimic
        # a sum follows independent joints already
        while mimic and not mimic.others and (above := joints[mimic.source].mimic):
            offset = mimic.ratio * above.offset + mimic.offset
            others = tuple((source, mimic.ratio * ratio) for source, ratio in above.others)
            mimic = Mimic(above.source, mimic.ratio * above.ratio, offset, others)
        if mimic and mimic != j.mimic:
            source = mimic.source
            done.append(
                f"joint {name} follows a follower of {source}: it follows {source} directly"
            )
            joints[name] = dataclasses.replace(j, mimic=mimic)
    return done


def _limit_leaders(urdf: Urdf, joints: dict[str, Joint]) -> list[str]:
    """Limit each independent joint to positions at which the joints coupled to it are within their
    limits.
    """
    done = []
    for name, j in joints.items():
        mimic = j.mimic
        if mimic is None:
            continue
        if not all(ratio for _, ratio in mimic.terms):
            found = f"joint {name} that follows with a ratio of 0"
            raise urdf.wrong(found, "a fixed joint, or another ratio")
        if mimic.others:
            done += _limit_sum(urdf, joints, j, mimic)
            continue
        leader = joints[mimic.source]
        ends = sorted((end - mimic.offset) / mimic.ratio for end in (j.lower, j.upper))
        low = max(leader.lower, ends[0])
        high = min(leader.upper, ends[1])
        if not low < high:
            found = f"joint {name} that follows {leader.name} outside its own limits"
            raise urdf.wrong(found, "limits that overlap")
        if (low, high) != (leader.lower, leader.upper):
            joints[leader.name] = dataclasses.replace(leader, lower=low, upper=high)
            new = f"[{low:.6g}, {high:.6g}]"
            old = f"[{leader.lower:.6g}, {leader.upper:.6g}]"
            done.append(
                f"joint {leader.name} is limited to {new} instead of {old}: "
                f"{name}, which follows it, would leave its own limits"
            )
    return done


def _limit_sum(urdf: Urdf, joints: dict[str, Joint], joint: Joint, mimic: Mimic) -> list[str]:
    """Narrow the ranges of all joints that one follows by a sum, so that it stays in its limits.

    Where the sum would pass a limit, each range gives the same share of its width.
    """
    ends = []
    for name, ratio in mimic.terms:
        ends.append(sorted((ratio * joints[name].lower, ratio * joints[name].upper)))
    widths = sum(high - low for low, high in ends)
    over = max(0.0, mimic.offset + sum(high for _, high in ends) - joint.upper) / widths
    under = max(0.0, joint.lower - mimic.offset - sum(low for low, _ in ends)) / widths
    if not over + under:
        return []
    if over + under >= 1:
        found = f"joint {joint.name} that follows a sum outside its own limits"
        raise urdf.wrong(found, "limits that overlap")
    told = []
    for name, ratio in mimic.terms:
        leader = joints[name]
        width = leader.upper - leader.lower
        below = under if ratio > 0 else over
        above = over if ratio > 0 else under
        low = leader.lower + below * width
        high = leader.upper - above * width
        joints[name] = dataclasses.replace(leader, lower=low, upper=high)
        told.append(f"{name} [{low:.6g}, {high:.6g}]")
    return [f"{joint.name} follows a sum, so the joints of it get narrower: {', '.join(told)}"]


def repair_bodies(urdf: Urdf, surfaces: Mapping[str, np.ndarray]) -> Step:
    """Return the URDF without missing or impossible masses and inertias, and sentences on the
    repair.

    A link without mass gets that of water in half its bounding box. An inertia or mass centre is
    impossible if no body of the link's size and mass has it. The inertia then becomes that of a box
    of this mass and size. An impossible mass centre becomes the middle of the bounding box.
    `surfaces` holds points (n, 3) [m] on each link, by its name, in its frame.
    """
    links = []
    weightless = list[str]()
    absurd = list[str]()
    for link in urdf.links:
        points = surfaces.get(link.name, np.zeros((1, 3)))
        low = points.min(0)
        high = points.max(0)
        size = np.maximum(high - low, REPAIRS.least_size)
        farthest = REPAIRS.far_out * (float(np.linalg.norm(size)) / 2)
        middle = (low + high) / 2
        mass = link.mass
        if not mass > 0:
            mass = max(REPAIRS.least_mass, REPAIRS.density * float(np.prod(high - low)))
            weightless.append(f"{link.name} ({1e3 * mass:.3g} g)")
        principal = np.linalg.eigvalsh(link.inertia_matrix)
        # of any body, two principal moments add up to the third or more
        largest = principal[2] * (1 - REPAIRS.rounding)
        sound = principal[0] > 0 and principal[0] + principal[1] >= largest
        known = link.name in surfaces
        off = known and math.dist(link.com, middle) > farthest
        wide = known and principal[2] > mass * farthest**2
        if not link.mass > 0 or not sound or off or wide:
            absurd += [link.name] if link.mass > 0 else []
            x, y, z = middle.tolist() if off or not link.mass > 0 else link.com
            inertia = mass / BOX * np.diag(size @ size - size**2)
            link = Link(link.name, mass, (x, y, z), _triangle(inertia), link.shapes)
        links.append(link)
    done = []
    if weightless:
        names = ", ".join(weightless)
        done.append(f"links without mass get the mass of half their bounding box: {names}")
    if absurd:
        done.append(
            f"{', '.join(absurd)} with an inertia or mass centre that is impossible for their "
            "size and mass get those of their bounding box"
        )
    return dataclasses.replace(urdf, links=tuple(links)), done


def _triangle(inertia: np.ndarray) -> tuple[float, ...]:
    return tuple(inertia[np.triu_indices(3)].tolist())
