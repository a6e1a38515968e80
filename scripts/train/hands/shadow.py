"""The numbers of the right Shadow hand with a fixed wrist; hands/README.md tells where each comes from."""

import math

from train.hands.files import Body, Joint, Shape, Table, Tip, Triple

FINGERS = {
    "index": ("FF", (0.033, 0, 0.095), -1),
    "middle": ("MF", (0.011, 0, 0.099), -1),
    "ring": ("RF", (-0.011, 0, 0.095), 1),
}
"""Letters of a finger's joints, where its knuckle is [m], and the sign of the knuckle's axis."""
QUARTER = math.pi / 2
"""A right angle."""
FLEXION: Triple = (1, 0, 0)
FINGER_DRIVE = (2.0, 2.0)
"""Effort [N m] and velocity [rad/s] of the fingers' joints."""
TILT = math.radians(30)
"""Of the contact's normal from the palmar axis to the finger's end, as in the Allegro hand."""
NORMAL = (0.0, -math.cos(TILT), math.sin(TILT))
"""Of every contact, in its tip's link."""
TIP_MASS = 0.003
"""Share of a distal link's mass [kg] that is the ball's: about its share of the volume."""
FOREARM_RADIUS, FOREARM_PLACES = 0.072, (0.055, 0.09, 0.125)
"""Balls for the forearm, a cylinder of 68 mm: they stand out by 2 to 4 mm, and round its rims by 17 mm [m]."""


def shadow() -> Table:
    """Return the table of the right hand."""
    bodies, joints = _palm()
    for finger, (letters, knuckle, sign) in FINGERS.items():
        parts = _finger(finger, letters, ("palm", knuckle, (0, 0, 0)), sign)
        bodies += parts[0]
        joints += parts[1]
    slab = Shape((0.018, 0.024, 0.04), (0.027, 0, 0.019), (0, 0.96, 0))
    bodies.append(Body("little_metacarpal", 0.03, (slab,)))
    joints.append(_joint("LFJ5", "palm", "little_metacarpal", (-0.033, 0, 0.02071), (0, 0.785398163397)))
    joints[-1] = joints[-1]._replace(rpy=(0, -0.9599, 0))
    mount = ("little_metacarpal", (0.05397275, 0, 0.03779463), (0, 0.9599, 0))
    for parts in (_finger("little", "LF", mount, 1), _thumb()):
        bodies += parts[0]
        joints += parts[1]
    parked = {f"{f}FJ{k}": v for f in ("R", "L") for k, v in ((4, 0.0), (3, -0.261799387799), (2, 0.0))}
    return Table(
        name="shadow",
        title="Shadow right hand, its wrist fixed",
        frame="Frame of the palm: -y out of the palm, +x to the index side, +z to the fingertips.",
        approach=(0, -1, 0),
        drive=(3.0, 0.1),
        bodies=tuple(bodies),
        joints=tuple(joints),
        tips=(
            *(Tip(f, f"{f}_tip", 0.007, NORMAL) for f in (*FINGERS, "little")),
            Tip("thumb", "thumb_tip", 0.008, NORMAL),
        ),
        options={
            "default": ("index", "middle", "thumb"),
            "four": (*FINGERS, "thumb"),
            "five": (*FINGERS, "little", "thumb"),
        },
        parked={**parked, "LFJ5": 0.0},
    )


def _joint(name: str, parent: str, child: str, xyz: Triple, limits: tuple[float, float]) -> Joint:
    """Return a joint of a finger that bends about x."""
    return Joint(name, parent, child, xyz, (0, 0, 0), FLEXION, limits, FINGER_DRIVE)


def _palm() -> tuple[list[Body], list[Joint]]:
    """Return palm, wrist and forearm."""
    palm = (
        Shape((0.062, 0.008, 0.088), (0.011, 0.008, 0.041)),
        Shape((0.036, 0.018, 0.088), (-0.002, -0.0035, 0.041)),
        Shape((0.026, 0.017, 0.024), (0.029, -0.0025, 0.073)),
        Shape((0.022, 0.028, 0.018), (0.0315, -0.0085, 0.005)),
        Shape((0.022, 0.009, 0.032), (0.0125, -0.0135, 0.013)),
        Shape((0.02, 0.024, 0.032), (-0.03, 0, 0.013)),
    )
    wrist = (Shape((0.068, 0.024, 0.022), (0.0025, 0, 0.034)), Shape((0.0135, 0.04), (0, 0, 0), (0, QUARTER, 0)))
    balls = tuple(Shape((FOREARM_RADIUS,), (0, 0, z)) for z in FOREARM_PLACES)
    mount = Shape((0.07, 0.07, 0.07), (0, -0.01, 0.165), (0, QUARTER / 2, 0))
    bodies = [Body("palm", 0.3, palm), Body("wrist", 0.1, wrist), Body("forearm", 3.0, (*balls, mount))]
    fixed = [
        Joint("WRJ1", "palm", "wrist", (0, 0, -0.034)),
        Joint("WRJ2", "wrist", "forearm", (0, 0.01, -0.21301)),
    ]
    return bodies, fixed


def _finger(finger: str, letters: str, mount: tuple[str, Triple, Triple], sign: int) -> tuple[list[Body], list[Joint]]:
    """Return links and joints of a finger."""
    knuckle, proximal, middle, distal, tip = (
        f"{finger}_{x}" for x in ("knuckle", "proximal", "middle", "distal", "tip")
    )
    bodies = [
        Body(knuckle, 0.008, (Shape((0.008,)),)),
        Body(proximal, 0.03, (Shape((0.008, 0.037), (0, 0, 0.0265)),)),
        Body(middle, 0.017, (Shape((0.0075, 0.025), (0, 0, 0.0125)), Shape((0.0075,)))),
        Body(distal, 0.012 - TIP_MASS, (Shape((0.0075,)),)),
        Body(tip, TIP_MASS, (Shape((0.007,)), Shape((0.0066, 0.016), (0, -0.0002, -0.008)))),
    ]
    swivel = Joint(
        f"{letters}J4", mount[0], knuckle, mount[1], mount[2], (0, sign, 0), (-0.349065850399,) * 2, FINGER_DRIVE
    )
    bend = (0.0, 1.57079632679)
    joints = [
        swivel._replace(limits=(-0.349065850399, 0.349065850399)),
        _joint(f"{letters}J3", knuckle, proximal, (0, 0, 0), (-0.261799387799, bend[1])),
        _joint(f"{letters}J2", proximal, middle, (0, 0, 0.045), bend),
        _joint(f"{letters}J1", middle, distal, (0, 0, 0.025), bend)._replace(follows=f"{letters}J2"),
        Joint(f"{tip}_fixed", distal, tip, (0, 0.0008, 0.025)),
    ]
    return bodies, joints


def _thumb() -> tuple[list[Body], list[Joint]]:
    """Return links and joints of the thumb."""
    bodies = [
        Body("thumb_base", 0.01, (Shape((0.011,)),)),
        Body("thumb_proximal", 0.04, (Shape((0.012, 0.024), (0, 0, 0.02)),)),
        Body("thumb_hub", 0.005, (Shape((0.01,)),)),
        Body("thumb_middle", 0.02, (Shape((0.01, 0.028), (0, 0, 0.018)),)),
        Body("thumb_distal", 0.016 - TIP_MASS, (Shape((0.0095,)),)),
        Body("thumb_tip", TIP_MASS, (Shape((0.008,)), Shape((0.0078, 0.015), (0, -0.0005, -0.0075)))),
    ]
    turn, aside = (-0.785398163397, 0, -1.57079632679), (0, 1, 0)
    joints = [
        Joint(
            "THJ5",
            "palm",
            "thumb_base",
            (0.034, -0.00858, 0.029),
            turn,
            (0, 0, -1),
            (-1.0471975512, 1.0471975512),
            (5, 4),
        ),
        Joint("THJ4", "thumb_base", "thumb_proximal", (0, 0, 0), (0, 0, 0), aside, (0, 1.2217304764), (3, 4)),
        Joint(
            "THJ3",
            "thumb_proximal",
            "thumb_hub",
            (0, 0, 0.038),
            (0, 0, 0),
            aside,
            (-0.209439510239, 0.209439510239),
            (2, 4),
        ),
        Joint(
            "THJ2",
            "thumb_hub",
            "thumb_middle",
            (0, 0, 0),
            (0, 0, 0),
            FLEXION,
            (-0.698131700798, 0.698131700798),
            (2, 2),
        ),
        Joint(
            "THJ1",
            "thumb_middle",
            "thumb_distal",
            (0, 0, 0.032),
            (0, 0, 0),
            FLEXION,
            (-0.261799387799, 1.57079632679),
            (1, 4),
        ),
        Joint("thumb_tip_fixed", "thumb_distal", "thumb_tip", (0, 0.0015, 0.027)),
    ]
    return bodies, joints
