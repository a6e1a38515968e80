"""The two files of a hand, hand.urdf and hand.toml, written from a table of its numbers."""

import json
from typing import NamedTuple

import numpy as np

from torchgrasp.geometry.frames import rotation_from_rpy

DIGITS = 4
"""Significant digits of centres of mass and inertias, which the density of no real link justifies."""

Triple = tuple[float, float, float]
ZERO: Triple = (0.0, 0.0, 0.0)


class Shape(NamedTuple):
    """A collision shape: `size` is (x, y, z) of a box, (radius,) of a sphere, (radius, length) of a cylinder [m]."""

    size: tuple[float, ...]
    xyz: Triple = ZERO
    rpy: Triple = ZERO

    @property
    def kind(self) -> str:
        """The URDF's word for the shape."""
        return ("sphere", "cylinder", "box")[len(self.size) - 1]


class Body(NamedTuple):
    """A link: mass [kg], and shapes that share it at uniform density."""

    name: str
    mass: float
    shapes: tuple[Shape, ...]


class Joint(NamedTuple):
    """A joint of the tree, fixed without an axis; `follows` names the joint that it equals."""

    name: str
    parent: str
    child: str
    xyz: Triple
    rpy: Triple = ZERO
    axis: Triple | None = None
    limits: tuple[float, float] = (0.0, 0.0)
    drive: tuple[float, float] = (0.0, 0.0)  # effort [N m], velocity [rad/s]
    follows: str | None = None


class Tip(NamedTuple):
    """A fingertip: a ball at the origin of its link; `normal` is outward in the middle of the pad."""

    finger: str
    link: str
    radius: float
    normal: Triple


class Table(NamedTuple):
    """The numbers of a hand; `options` are grasping fingers by name, `parked` the values of the other joints."""

    name: str
    title: str
    frame: str
    approach: Triple
    drive: tuple[float, float]  # kp [N m/rad], kd [N m s/rad]
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    tips: tuple[Tip, ...]
    options: dict[str, tuple[str, ...]]
    parked: dict[str, float]


def format_urdf(table: Table) -> str:
    """Return the URDF: links and joints in the order of the table."""
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- {table.title}. {table.frame}",
        "     Origin of every number: hands/README.md. Collision shapes only; lengths in metres, masses in kg. -->",
        f'<robot name="{table.name}">',
    ]
    for body in table.bodies:
        com, inertia = mass_properties(body)
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        values = " ".join(f'{k}="{number(v, DIGITS)}"' for k, v in zip(keys, inertia, strict=True))
        lines += [f'  <link name="{body.name}">', "    <inertial>", f"      {origin(com, ZERO, DIGITS)}"]
        lines += [f'      <mass value="{number(body.mass)}"/>', f"      <inertia {values}/>", "    </inertial>"]
        for shape in body.shapes:
            lines += ["    <collision>", f"      {origin(shape.xyz, shape.rpy)}"]
            lines += [f"      <geometry>{geometry(shape)}</geometry>", "    </collision>"]
        lines.append("  </link>")
    for joint in table.joints:
        kind = "fixed" if joint.axis is None else "revolute"
        lines += [f'  <joint name="{joint.name}" type="{kind}">', f'    <parent link="{joint.parent}"/>']
        lines += [f'    <child link="{joint.child}"/>', f"    {origin(joint.xyz, joint.rpy)}"]
        if joint.axis is not None:
            (low, high), (effort, velocity) = joint.limits, joint.drive
            span = f'lower="{number(low)}" upper="{number(high)}"'
            lines.append(f'    <axis xyz="{numbers(joint.axis)}"/>')
            lines.append(f'    <limit {span} effort="{number(effort)}" velocity="{number(velocity)}"/>')
        if joint.follows:
            lines.append(f'    <mimic joint="{joint.follows}" multiplier="1" offset="0"/>')
        lines.append("  </joint>")
    return "\n".join([*lines, "</robot>", ""])


def format_toml(table: Table, pairs: list[tuple[str, str]]) -> str:
    """Return the hand.toml, with the pairs of links that can meet."""
    kp, kd = table.drive
    lines = [
        f"# {table.title}. Lengths [m], angles [rad], in the link frames of hand.urdf; "
        "origin of every number: ../README.md",
        f"name = {quoted(table.name)}",
        'urdf = "hand.urdf"',
        f"base_link = {quoted(table.bodies[0].name)}",
        f"approach = [{numbers(table.approach, ', ')}]  # out of the palm",
        "limit_margin = 0.0  # taken off both ends of every joint's range",
        "",
        "[actuators]  # joint position control; effort [N m] and velocity [rad/s] are those of the URDF",
        f"kp = {kp}  # [N m/rad]",
        f"kd = {kd}  # [N m s/rad]",
        "",
        "# Which fingers grasp, in grasp order; every other joint is parked.",
    ]
    moving = {finger: movers(table, finger) for finger in (tip.finger for tip in table.tips)}
    coupling = {j.name: j.follows for j in table.joints if j.follows}
    for option, fingers in table.options.items():
        grasping = {joint for finger in fingers for joint in moving[finger]}
        rest = ", ".join(f"{quoted(j)} = {v}" for j, v in table.parked.items() if j not in grasping)
        lines += [f"[options.{option}]", f"fingers = {quoted(fingers)}"]
        lines += [f"parked = {{ {rest} }}", ""] if rest else [""]
    if coupling:
        lines += ["# joint = ratio * source + offset", "[coupling]"]
        lines += [f"{j} = {{ source = {quoted(source)}, ratio = 1.0, offset = 0.0 }}" for j, source in coupling.items()]
        lines.append("")
    for tip in table.tips:
        contact = tuple(tip.radius * n for n in tip.normal)
        lines += ["[[finger]]", f"name = {quoted(tip.finger)}", f"joints = {quoted(moving[tip.finger])}"]
        lines += [f"tip_link = {quoted(tip.link)}", f"contact = [{numbers(contact, ', ', 12)}]"]
        lines += [f"normal = [{numbers(tip.normal, ', ', 16)}]", 'tip = "sphere"', "center = [0, 0, 0]"]
        lines += [f"radius = {tip.radius}", ""]
    lines += ["[self_collision]"]
    lines += [
        "# The pairs of links that come within 2 mm in 20,000 uniform postures of all joints, but for neighbours."
    ]
    return "\n".join([*lines, "pairs = [", *(f"  {quoted(pair)}," for pair in pairs), "]", ""])


def movers(table: Table, finger: str) -> tuple[str, ...]:
    """Return the joints that move a finger, from the palm outward."""
    above, link = {j.child: j for j in table.joints}, next(t.link for t in table.tips if t.finger == finger)
    chain: list[str] = []
    while link in above:
        if above[link].axis is not None:
            chain.append(above[link].name)
        link = above[link].parent
    return tuple(reversed(chain))


def mass_properties(body: Body) -> tuple[Triple, tuple[float, ...]]:
    """Return centre of mass and inertia about it (xx, xy, xz, yy, yz, zz) at uniform density of the shapes."""
    volumes = np.array([volume(s) for s in body.shapes])
    masses = body.mass * volumes / volumes.sum()
    places = np.array([s.xyz for s in body.shapes])
    com = masses @ places / body.mass
    total = np.zeros((3, 3))
    for shape, mass, place in zip(body.shapes, masses, places, strict=True):
        roll, pitch, yaw = (float(angle) for angle in shape.rpy)
        turn, arm = rotation_from_rpy((roll, pitch, yaw)).numpy(), place - com
        total += turn @ np.diag(principal(shape, mass)) @ turn.T + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    x, y, z = (float(v) for v in com)
    return (x, y, z), tuple(float(total[i, j]) for i in range(3) for j in range(i, 3))


def volume(shape: Shape) -> float:
    """Return the volume [m3]."""
    if shape.kind == "sphere":
        return 4 / 3 * np.pi * shape.size[0] ** 3
    return np.pi * shape.size[0] ** 2 * shape.size[1] if shape.kind == "cylinder" else float(np.prod(shape.size))


def principal(shape: Shape, mass: float) -> Triple:
    """Return the principal inertias [kg m2] of a solid shape in its own axes."""
    if shape.kind == "sphere":
        return (0.4 * mass * shape.size[0] ** 2,) * 3
    if shape.kind == "cylinder":
        radius, length = shape.size
        across = mass * (radius**2 / 4 + length**2 / 12)
        return across, across, mass * radius**2 / 2
    x, y, z = (s**2 * mass / 12 for s in shape.size)
    return y + z, x + z, x + y


def geometry(shape: Shape) -> str:
    """Return the URDF's element."""
    if shape.kind == "box":
        return f'<box size="{numbers(shape.size)}"/>'
    length = f' length="{number(shape.size[1])}"' if shape.kind == "cylinder" else ""
    return f'<{shape.kind} radius="{number(shape.size[0])}"{length}/>'


def origin(xyz: Triple, rpy: Triple, digits: int = 12) -> str:
    """Return an origin; without its angles if they are 0."""
    turn = f' rpy="{numbers(rpy)}"' if any(rpy) else ""
    return f'<origin xyz="{numbers(xyz, digits=digits)}"{turn}/>'


def number(value: float, digits: int = 12) -> str:
    """Return a number that reads shortly; what is 0 but for rounding is 0."""
    return f"{0.0 if abs(value) < 1e-12 else value:.{digits}g}"


def numbers(values: tuple[float, ...], between: str = " ", digits: int = 12) -> str:
    """Return several numbers."""
    return between.join(number(v, digits) for v in values)


def quoted(words: object) -> str:
    """Return words as TOML."""
    return json.dumps(words)
