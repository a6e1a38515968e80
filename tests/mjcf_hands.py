"""Hands of our own making as MJCF: boxes, capsules and spheres only, joints as bought hands have
them.
"""

from collections.abc import Sequence
from typing import NamedTuple

PALM = "0.055 0.06 0.015"  # half sizes of the palm [m]


class Hinge(NamedTuple):
    """A joint of a finger: its name in the finger, axis, and limits [degrees]."""

    name: str
    axis: str
    low: float
    high: float
    more: str = ""  # further attributes of the joint


SWIVEL = Hinge("swivel", "1 0 0", -45, 45)
BEND = Hinge("bend", "0 1 0", -45, 90)
CURL = Hinge("curl", "0 1 0", -20, 95)
TIP = Hinge("end", "0 1 0", -10, 80)
LENGTH = {"swivel": 0.018, "bend": 0.058, "curl": 0.044, "end": 0.03}


def finger(
    name: str, x: float, y: float, yaw: float, hinges: Sequence[Hinge], end: str, site: bool = True
) -> str:
    """Return the bodies of a finger that points up and bends inward, with its tip's geoms `end`."""
    text = ""
    above = 0.0
    place = f'pos="{x} {y} 0.02" euler="0 0 {yaw}"'
    for hinge in hinges:
        length = LENGTH[hinge.name]
        last = hinge is hinges[-1]
        geom = f'<geom type="box" size="0.008 0.009 {length / 2 - 0.003:.6g}" pos="0 0 {length / 2:.6g}"/>'
        place = place or f'pos="0 0 {above:.6g}"'
        text += (
            f'<body name="{name}_{hinge.name}" {place}>'
            f'<joint name="{name}_{hinge.name}" axis="{hinge.axis}" '
            f'range="{hinge.low} {hinge.high}" {hinge.more}/>{geom}'
        )
        if last:
            text += end.format(name=name, z=length)
            text += f'<site name="{name}_tip" pos="0 0 {length + 0.008:.6g}"/>' if site else ""
        above = length
        place = ""
    return text + "</body>" * len(hinges)


def model(name: str, bodies: str, rest: str, base: str = "", head: str = "") -> str:
    """Return an MJCF of a palm with fingers, in degrees and with a default class."""
    return (
        f'<mujoco model="{name}"><compiler angle="degree" autolimits="true"/>{head}'
        '<default><geom density="900"/><joint damping="0.05"/>'
        '<default class="pad"><geom type="sphere" size="0.011" solref="0.02 1" solimp="0.6 0.9 0.004" '
        'friction="1 0.01 0.001"/></default></default>'
        f'<worldbody><geom type="plane" size="1 1 0.1" pos="0 0 -0.5"/><body name="palm" pos="0 0 0.3">'
        f'{base}<geom type="box" size="{PALM}"/>{bodies}</body></worldbody>{rest}</mujoco>'
    )


def motors(names: Sequence[str], force: float = 1.5) -> str:
    return "".join(
        f'<position name="{n}" joint="{n}" kp="5" forcerange="-{force} {force}"/>' for n in names
    )


ROUND = '<geom class="pad" pos="0 0 {z:.6g}"/>'
SOFT = (
    '<geom type="capsule" size="0.0095" fromto="0 0 0.006 0 0 {z:.6g}" solref="0.03 1" '
    'solimp="0.3 0.9 0.006"/>'
)
THREE = (
    ("left", -0.041, -0.0287, 35.0),
    ("right", -0.041, 0.0287, -35.0),
    ("thumb", 0.05, 0.0, 180.0),
)


def tendon_hand() -> str:
    """Three fingers of two motors each: a swivel, and a tendon that bends two joints with springs.

    The thumb's motor turns a pulley; an equality ties its tendon to that of the finger.
    """
    bend = BEND._replace(more='stiffness="0.4" springref="-10"')
    curl = CURL._replace(more='stiffness="0.8"')
    bodies = "".join(finger(*place, (SWIVEL, bend, curl), ROUND) for place in THREE)
    bodies += (
        '<body name="pulley" pos="0 0 -0.03"><joint name="pulley" axis="1 0 0" range="-200 200"/>'
        '<inertial pos="0 0 0" mass="0.02" diaginertia="2e-6 2e-6 2e-6"/></body>'
    )
    tendons = "".join(
        f'<fixed name="{n}"><joint joint="{n}_bend" coef="0.012"/>'
        f'<joint joint="{n}_curl" coef="0.010"/></fixed>'
        for n in ("left", "right", "thumb")
    )
    tendons += '<fixed name="drum"><joint joint="pulley" coef="0.009"/></fixed>'
    pulls = "".join(
        f'<position name="{n}" tendon="{n}" kp="900" forcerange="-120 120"/>'
        for n in ("left", "right")
    )
    rest = (
        f"<tendon>{tendons}</tendon>"
        '<equality><tendon tendon1="thumb" tendon2="drum" polycoef="0.001 1.1 0 0 0"/></equality>'
        f"<actuator>{motors([f'{n}_swivel' for n, *_ in THREE] + ['pulley'])}{pulls}</actuator>"
    )
    return model("tendons", bodies, rest)


def soft_hand() -> str:
    """Five fingers with 21 joints and soft capsules as pads; the last joints of three follow."""
    row = [(n, -0.045, y, 0.0) for n, y in zip("abcd", (-0.06, -0.02, 0.02, 0.06), strict=True)]
    flat = SWIVEL._replace(low=-30, high=30)
    fingers = "".join(finger(*place, (flat, BEND, CURL, TIP), SOFT) for place in row)
    thumb = finger("thumb", 0.0, 0.0, 180.0, (SWIVEL, BEND, CURL, TIP), SOFT)
    fingers += (
        '<body name="root" pos="0.045 0 0"><joint name="roll" axis="1 0 0" range="-20 20"/>'
        f'<geom type="sphere" size="0.009"/>{thumb}</body>'
    )
    ties = "".join(
        f'<joint joint1="{n}_end" joint2="{n}_curl" polycoef="0.05 0.8 0 0 0"/>' for n in "abd"
    )
    names = ["roll"]
    for n in ("a", "b", "c", "d", "thumb"):
        joints = ("swivel", "bend", "curl") if n in "abd" else ("swivel", "bend", "curl", "end")
        names += [f"{n}_{joint}" for joint in joints]
    rest = f"<equality>{ties}</equality><actuator>{motors(names)}</actuator>"
    return model("soft", fingers, rest)


def seven_hand() -> str:
    """Three fingers with seven joints: a thumb of three, and two fingers of two; no sites."""
    two = "".join(finger(*place, (BEND, CURL), ROUND, site=False) for place in THREE[:2])
    thumb = finger(*THREE[2], (SWIVEL, BEND, CURL), ROUND, site=False)
    names = ["thumb_swivel"] + [f"{n}_{j}" for n, *_ in THREE for j in ("bend", "curl")]
    torque = "".join(
        f'<motor name="{n}" joint="{n}" gear="2" ctrlrange="-0.6 0.6"/>' for n in names
    )
    return model("seven", two + thumb, f"<actuator>{torque}</actuator>")


def floating_hand() -> str:
    """Four fingers on a free base; swivel and bend turn one body, and `ref` shifts their zero."""
    row = [(n, -0.045, y, 0.0) for n, y in (("a", -0.042), ("b", 0.0), ("c", 0.042))]
    bodies = ""
    names = []
    for name, x, y, yaw in [*row, ("thumb", 0.045, 0.0, 180.0)]:
        inner = finger(name, 0.0, 0.0, 0.0, (CURL, TIP), ROUND)
        inner = inner.replace('pos="0.0 0.0 0.02" euler="0 0 0.0"', 'pos="0 0 0.05"')
        bodies += (
            f'<body name="{name}_base" pos="{x} {y} 0.026" euler="0 0 {yaw}">'
            f'<joint name="{name}_swivel" axis="1 0 0" pos="0.001 0 0" range="-35 45" ref="5"/>'
            f'<joint name="{name}_bend" axis="0 1 0" pos="0 0 0.004" range="-35 100" ref="10"/>'
            f'<geom type="box" size="0.008 0.009 0.02" pos="0 0 0.026"/>{inner}</body>'
        )
        names += [f"{name}_{joint}" for joint in ("swivel", "bend", "curl", "end")]
    rest = (
        f"<actuator>{motors(names)}</actuator>"
        '<keyframe><key name="home" qpos="0 0 1 1 0 0 0 ' + "0 " * len(names) + '"/></keyframe>'
    )
    ball = (
        '</body><body name="toy" pos="1 0 0"><freejoint/><geom type="sphere" size="0.03"/></body>'
    )
    text = model("floating", bodies, rest, base='<freejoint name="float"/>')
    return text.replace("</body></worldbody>", f"{ball}</worldbody>")


HANDS = {"tendons": tendon_hand, "soft": soft_hand, "seven": seven_hand, "floating": floating_hand}
