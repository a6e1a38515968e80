"""The numbers of the LEAP hand, right and left; hands/README.md tells where each comes from.

Both sides have the same modules of fingers and thumb. Only the palm and two links of the thumb's base are mirrored.
"""

import math

from train.hands.files import Body, Joint, Shape, Table, Tip

SIDES = {
    "right": ("leap", "palm_lower", (-0.007, -0.0071, -0.00709), -0.0187, (0.023, -0.0224, -0.0678)),
    "left": ("leap_left", "palm_lower_left", (-0.0825,) * 3, 0.0078, (-0.0857, -0.0403, 0.0051)),
}
"""Names of hand and root, and where the fingers are hinged: x of each, z of all, y of each [m]."""
THUMBS = {"right": ((-0.0693, -0.0012, -0.0216), 1), "left": ((-0.1448, -0.09, 0.0049), -1)}
"""Where the thumb is hinged [m], and the sign of y and of its first two joints."""
QUARTER = 1.57079
"""A right angle, with the digits of the public description, to which positions agree to a micrometre."""
DRIVE = (0.95, 8.48)
"""Effort [N m] and velocity [rad/s] of every motor."""
FINGERS = ("index", "middle", "ring")
"""The three equal ones."""
TIP_RADIUS, TIP_INSET = 0.0105, 0.0396
"""The ball that touches the pad's face and the end of the soft tip, and how far it lies from the last joint [m]."""
TILT = math.radians(30)
"""Of the contact's normal from the palmar axis to the finger's end, as in the Allegro hand."""
PALM = (
    Shape((0.022, 0.026, 0.034), (-0.009, 0.008, -0.011)),  # motors of the knuckles
    Shape((0.022, 0.026, 0.034), (-0.009, -0.037, -0.011)),
    Shape((0.022, 0.026, 0.034), (-0.009, -0.082, -0.011)),
    Shape((0.018, 0.12, 0.03), (-0.029, -0.035, -0.0035)),
    Shape((0.024, 0.118, 0.046), (-0.048, -0.034, -0.0115)),
    Shape((0.042, 0.052, 0.046), (-0.079, -0.053, -0.0115)),
    Shape((0.058, 0.02, 0.046), (-0.066, -0.078, -0.0115), (0, 0, -0.3)),
    Shape((0.042, 0.056, 0.005), (-0.079, -0.003, 0.0095)),  # behind the motor of the thumb
    Shape((0.005, 0.036, 0.034), (-0.0975, -0.009, -0.006)),
)
"""Collision shapes of the right palm."""
MIRROR = (-0.0755, -0.0921, 0.0265)
"""The left palm is the right one with y negated, moved by this [m]: the fingers' middle planes then agree."""


def leap(side: str) -> Table:
    """Return the table of the right or the left hand."""
    name, palm, xs, z, ys = SIDES[side]
    bodies, joints = [Body(palm, 0.237 if side == "right" else 0.235, palm_shapes(side))], []
    for k, finger in enumerate(FINGERS):
        parts = _finger(finger, palm, (xs[k], ys[k], z), 4 * k)
        bodies += parts[0]
        joints += parts[1]
    parts = _thumb(palm, side)
    normal = (-math.cos(TILT), -math.sin(TILT), 0.0)
    return Table(
        name=name,
        title=f"LEAP {side} hand",
        frame=f"Frame of {palm}: +x to the fingertips, -z out of the palm.",
        approach=(0, 0, -1),
        drive=(3.0, 0.1),
        bodies=(*bodies, *parts[0]),
        joints=(*joints, *parts[1]),
        tips=tuple(Tip(f, f"{f}_tip", TIP_RADIUS, normal) for f in (*FINGERS, "thumb")),
        options={"default": ("index", "middle", "thumb"), "four": (*FINGERS, "thumb")},
        parked={"8": 0.0, "9": -0.314, "10": -0.2, "11": -0.366},
    )


def palm_shapes(side: str) -> tuple[Shape, ...]:
    """Return the shapes of a palm."""
    if side == "right":
        return PALM
    x, y, z = MIRROR
    return tuple(
        Shape(s.size, (round(s.xyz[0] + x, 6), round(y - s.xyz[1], 6), round(s.xyz[2] + z, 6)), (0, 0, -s.rpy[2]))
        for s in PALM
    )


def _soft_tip(finger: str, y: float, z: float) -> tuple[Body, Joint]:
    """Return the soft end of a finger, whose ball lies at (0.8 mm, y, z) of the last link, with its joint."""
    back = TIP_INSET - 0.0195
    stem = Shape((0.01, back), (0, back / 2, 0), (QUARTER, 0, 0))
    body = Body(f"{finger}_tip", 0.008, (Shape((TIP_RADIUS,)), stem))
    return body, Joint(f"{finger}_tip_fixed", f"{finger}_distal", f"{finger}_tip", (0.0008, y, z))


def _finger(finger: str, palm: str, hinge: tuple[float, float, float], first: int) -> tuple[list[Body], list[Joint]]:
    """Return links and joints of a finger whose motors have the numbers from `first` on."""
    tip, tip_joint = _soft_tip(finger, -TIP_INSET, 0.0145)
    inset = -0.03609 if finger == "ring" else -0.0361
    bodies = [
        Body(
            f"{finger}_mcp",
            0.044,
            (
                Shape((0.02, 0.026, 0.035), (0, 0.008, 0.0145)),
                Shape((0.03, 0.045, 0.02), (-0.027, 0.0395, 0.015)),
                Shape((0.018, 0.024, 0.008), (-0.0295, 0.035, 0.029)),
            ),
        ),
        Body(f"{finger}_pip", 0.032, (Shape((0.034, 0.026, 0.022), (0.0075, 0, -0.011)),)),
        Body(
            f"{finger}_dip",
            0.037,
            (Shape((0.016, 0.027, 0.034), (0, -0.0095, 0.015)), Shape((0.034, 0.022, 0.026), (0.0075, -0.035, 0.015))),
        ),
        Body(f"{finger}_distal", 0.008, (Shape((0.018, 0.025, 0.035), (0, -0.0075, 0.0145)),)),
        tip,
    ]
    turn, axis = (QUARTER, QUARTER, 0), (0, 0, -1)
    joints = [
        Joint(str(first + 1), palm, f"{finger}_mcp", hinge, turn, axis, (-0.314, 2.23), DRIVE),
        Joint(
            str(first),
            f"{finger}_mcp",
            f"{finger}_pip",
            (-0.0122, 0.0381, 0.0145),
            (-QUARTER, 0, QUARTER),
            axis,
            (-1.047, 1.047),
            DRIVE,
        ),
        Joint(
            str(first + 2),
            f"{finger}_pip",
            f"{finger}_dip",
            (0.015, 0.0143, -0.013),
            (QUARTER, -QUARTER, 0),
            axis,
            (-0.506, 1.885),
            DRIVE,
        ),
        Joint(
            str(first + 3),
            f"{finger}_dip",
            f"{finger}_distal",
            (0, inset, 0.0002),
            (0, 0, 0),
            axis,
            (-0.366, 2.042),
            DRIVE,
        ),
        tip_joint,
    ]
    return bodies, joints


def _thumb(palm: str, side: str) -> tuple[list[Body], list[Joint]]:
    """Return links and joints of the thumb."""
    hinge, sign = THUMBS[side]
    tip, tip_joint = _soft_tip("thumb", -TIP_INSET - 0.012, -0.0145)
    bodies = [
        Body("thumb_mcp", 0.032, (Shape((0.034, 0.026, 0.022), (0.0075 * sign, 0, -0.011)),)),
        Body("thumb_pip", 0.003, (Shape((0.018, 0.034, 0.0235), (0, 0, -0.0113)),)),
        Body(
            "thumb_dip",
            0.038,
            (
                Shape((0.02, 0.04, 0.024), (0, 0.0105, -0.014)),
                Shape((0.018, 0.023, 0.034), (0, 0.0405, -0.014)),
                Shape((0.01, 0.024, 0.018), (-0.0135, 0.0175, -0.0115)),
            ),
        ),
        Body(
            "thumb_distal",
            0.041,
            (
                Shape((0.02, 0.04, 0.024), (0, -0.0105, -0.015)),
                Shape((0.009, 0.024, 0.018), (0.0145, -0.0175, -0.0115)),
            ),
        ),
        tip,
    ]
    limits = [(-0.349, 2.094), (-0.47, 2.443)]
    turned = [(low, high) if sign > 0 else (-high, -low) for low, high in limits]
    axis = (0, 0, -1)
    joints = [
        Joint("12", palm, "thumb_mcp", hinge, (0, QUARTER, 0), axis, turned[0], DRIVE),
        Joint(
            "13",
            "thumb_mcp",
            "thumb_pip",
            (0, 0.0143 * sign, -0.013),
            (QUARTER * sign, -QUARTER, 0),
            axis,
            turned[1],
            DRIVE,
        ),
        Joint("14", "thumb_pip", "thumb_dip", (0, 0.0145, -0.017), (-QUARTER, 0, 0), axis, (-1.2, 1.9), DRIVE),
        Joint("15", "thumb_dip", "thumb_distal", (0, 0.0466, 0.0002), (0, 0, 3.14159), axis, (-1.34, 1.88), DRIVE),
        tip_joint,
    ]
    return bodies, joints
