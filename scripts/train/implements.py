"""Tools of a household, with handles, blades and jaws. Lengths are in mm, and long tools lie.

Each function makes one body of its family; `draw` draws its sizes.
"""

import math

import numpy as np

from train.solids import (
    Draw,
    Thing,
    arc,
    around,
    box,
    join,
    lump,
    move,
    path,
    pebble,
    prism,
    rod,
    slab,
    stack,
    turn,
    vessel,
)


def spatula(draw: Draw) -> Thing:
    """A handle with a broad, thin blade that may be cranked."""
    handle = draw(70, 140)
    blade = draw(50, 95)
    rise = draw(0, 25)
    line = np.array([(-handle, 0, rise + 5), (-20, 0, rise + 5), (8, 0, 4)])
    return path(line, draw(3.5, 7), draw(6, 12)) + move(
        slab(blade, draw(35, 85), draw(2.5, 6), 8, 0.5), blade / 2
    )


def spoon(draw: Draw) -> Thing:
    """A filled spoon with a bent handle."""
    a = draw(18, 38)
    b = draw(12, 26)
    length = draw(70, 165)
    line = np.array(
        [(0.7 * a, 0, 8), (a + 15, 0, 12), (a + 0.6 * length, 0, draw(12, 24)), (a + length, 0, 10)]
    )
    return move(pebble(a, b, draw(5, 9)), z=7) + path(
        line, draw(2.2, 4), [draw(3, 5), 3, draw(4, 8), draw(5, 9)]
    )


def fork(draw: Draw) -> Thing:
    """A fork, a rake or a comb of two to five prongs on a handle."""
    count = int(draw(2, 6))
    tine = draw(30, 65)
    length = draw(70, 150)
    wide = draw(5, 7)
    gap = wide + draw(3, 9)
    sides = (np.arange(count) - (count - 1) / 2) * gap
    prongs = join(
        path(
            np.array([(-8, y, 5), (0.5 * tine, y, 6), (tine, y, 12)]),
            2.5,
            [0.5 * wide, 0.45 * wide, 0.3 * wide],
        )
        for y in sides.tolist()
    )
    bridge = box(14, (count - 1) * gap + wide, 6, (-8, 0, 2))
    return (
        prongs + bridge + path(np.array([(-10, 0, 5), (-length, 0, 9)]), draw(2.5, 5), draw(4, 9))
    )


def comb(draw: Draw) -> Thing:
    """A spine with many teeth."""
    count = int(draw(6, 20))
    pitch = draw(7, 11)
    tooth = draw(18, 40)
    h = draw(6, 12)
    places = [((k - (count - 1) / 2) * pitch, tooth / 2, 0) for k in range(count)]
    return join(box(0.5 * pitch, tooth, h - 1, at) for at in places) + box(
        count * pitch + 6, draw(12, 26), h, (0, -5, 0)
    )


def knife(draw: Draw) -> Thing:
    """A knife that lies on its side, with a handle and a pointed blade."""
    handle = draw(80, 125)
    blade = draw(60, 120)
    wide = draw(18, 40)
    h = draw(9, 18)
    outline = [
        (-5, -wide / 2),
        (0.6 * blade, -0.45 * wide),
        (blade, 0.35 * wide),
        (blade, 0.5 * wide),
        (-5, 0.5 * wide),
    ]
    grip = move(slab(handle, draw(16, 28), h, 6, 0.25 * h), x=-handle / 2)
    return grip + move(prism(outline, draw(2, 4)), z=0.4 * h)


def brush(draw: Draw) -> Thing:
    """A brush: a handle, a head and a block of bristles."""
    handle = draw(60, 130)
    head = draw(30, 100)
    wide = draw(14, 60)
    thick = draw(8, 16)
    bristles = move(slab(0.9 * head, 0.85 * wide, draw(12, 35) + thick, 3, 0.5), x=head / 2)
    return (
        bristles
        + move(slab(head, wide, thick, 5, 2), x=head / 2)
        + rod((5, 0, 5), (-handle, 0, 6), 5, draw(5, 9))
    )


def broad(draw: Draw) -> Thing:
    """A paint brush: a flat head of bristles that tapers, a ferrule and a thin handle."""
    wide = draw(20, 75)
    hair = draw(35, 60)
    handle = draw(90, 130)
    h = draw(10, 20)
    tip = [(hair, t * 0.48 * wide, z) for t in (-1, 1) for z in (0.35 * h, 0.65 * h)]
    root = [(0.0, t * 0.48 * wide, z) for t in (-1, 1) for z in (0.05 * h, 0.95 * h)]
    line = np.array([(-10, 0, h / 2), (-25, 0, h / 2), (-40, 0, h / 2), (-25 - handle, 0, h / 2)])
    return (
        lump(np.array(tip + root))
        + box(22, wide, h, (-10, 0, 0))
        + path(line, [0.4 * h, 0.4 * h, 4, 5], [0.4 * wide, 8, 6, 8])
    )


def hammer(draw: Draw) -> Thing:
    """A hammer or a mallet, lying."""
    length = draw(130, 220)
    r = draw(6, 13)
    head = draw(55, 110)
    face = draw(9, 24)
    if draw(0, 1) < 0.5:
        top = turn(stack([(face, -head / 2), (face, head / 2)]), "x", 90)
    else:
        claw = [(s * 0.4 * face, head / 2, z) for s in (-1, 1) for z in (-2, 2)]
        top = box(1.6 * face, head, 1.6 * face, (0, -0.2 * head, -0.8 * face)) + lump(
            np.array(
                claw
                + [
                    (s * 0.7 * face, 0.2 * head, z)
                    for s in (-1, 1)
                    for z in (-0.7 * face, 0.7 * face)
                ]
            )
        )
    return top + rod((-0.5 * face, 0, 0), (length - face, 0, 0), 0.8 * r, r)


def axe(draw: Draw) -> Thing:
    """A small axe or a cleaver, lying."""
    length = draw(120, 190)
    r = draw(7, 11)
    head = draw(35, 70)
    edge = draw(1, 4)
    blade = [(-18, 10, z) for z in (-12, 12)] + [(16, 10, z) for z in (-12, 12)]
    blade += [(x, 10 + head, z) for x in (-30, 28) for z in (-edge, edge)]
    return (
        lump(np.array(blade))
        + box(34, 34, 26, (-1, 0, -13))
        + rod((-22, 0, 0), (length - 22, 0, 0), r, 0.9 * r)
    )


def screwdriver(draw: Draw) -> Thing:
    """A screwdriver, a file or an awl, lying."""
    r = draw(9, 18)
    grip = draw(60, 110)
    shaft = draw(40, 130)
    sides = 8 if draw(0, 1) < 0.5 else 24
    handle = [(0.8 * r, 0), (r, 8), (r, 0.6 * grip), (0.7 * r, 0.8 * grip), (0.85 * r, grip)]
    return turn(
        stack(handle, sides=sides)
        + stack([(draw(2.5, 5), grip - 5), (draw(2, 4), grip + shaft)], sides=12),
        "x",
        90,
    )


def torch(draw: Draw) -> Thing:
    """A flashlight or a microphone: a grip and a wider head, lying."""
    r = draw(10, 20)
    grip = draw(70, 140)
    neck = draw(8, 25)
    head = draw(15, 45)
    wide = draw(1.2, 1.9) * r
    outline = [(0.9 * r, 0), (r, 3), (r, grip), (wide, grip + neck), (wide, grip + neck + head)]
    round_end = [
        (0.8 * wide, grip + neck + head + 0.5 * wide),
        (0.4 * wide, grip + neck + head + 0.8 * wide),
    ]
    return turn(stack(outline + (round_end if draw(0, 1) < 0.4 else [])), "x", 90)


def wrench(draw: Draw) -> Thing:
    """A spanner with an open jaw, and a ring or a jaw at its other end."""
    length = draw(90, 170)
    h = draw(6, 14)
    wide = draw(10, 22)
    size = draw(0.75, 1.1) * wide
    jaw = path(arc(size + 2, 50, 310, 11, (0, 0, 0)), 0.45 * wide, h / 2, sides=4)
    other = path(
        arc(0.9 * size + 3, 0, 337.5, 16, (0, 0, 0)), 0.4 * wide, 0.45 * h, closed=True, sides=4
    )
    start = -size - 2
    end = -size - length
    shank = box(length, wide, 0.8 * h, ((start + end) / 2, 0, -0.4 * h))
    tail = other if draw(0, 1) < 0.5 else turn(jaw, "y", 180)
    return turn(jaw, "x", 90) + move(turn(tail, "x", 90), x=end - 0.9 * size) + shank


def scissors(draw: Draw) -> Thing:
    """Scissors that are open a little: two rings, two crossed blades."""
    r = draw(11, 18)
    t = draw(3, 5)
    blade = draw(50, 110)
    arm = draw(25, 55)
    open_ = draw(6, 14)
    thing = rod((0, 0, 0), (0, 0, 2 * t + 2), draw(4, 6))
    for s in (-1, 1):
        loop = turn(
            path(arc((draw(1.0, 1.5) * r + t, r + t), 0, 337.5, 16, (0, 0, 0)), t, t, closed=True),
            "x",
            90,
        )
        outline = [
            (-arm, -4),
            (0, -7),
            (0.7 * blade, -5),
            (blade, -1),
            (blade, 1),
            (0, 7),
            (-arm, 4),
        ]
        leg = prism(outline, t + 1.5)
        half = (
            move(loop, x=-arm - r - 2, y=0.35 * r, z=t)
            if s > 0
            else move(loop, x=-arm - r - 2, y=-0.35 * r, z=t)
        )
        thing += turn(
            half + move(leg, z=0 if s > 0 else t),
            "z",
            -s * open_ - s * math.degrees(math.atan2(0.5 * r, arm + r)),
        )
    return thing


def pliers(draw: Draw) -> Thing:
    """Pliers: two bowed grips that meet at a joint, and two jaws."""
    length = draw(80, 130)
    t = draw(4, 7)
    bow = draw(14, 28)
    jaw = draw(25, 55)
    thing = stack([(draw(9, 14), -t - 1), (10, t + 1)])
    for s in (-1, 1):
        line = np.array(
            [
                (0, 0, 0),
                (-0.25 * length, 0, s * bow),
                (-0.6 * length, 0, s * 1.1 * bow),
                (-length, 0, s * bow),
            ]
        )
        thing += turn(path(line, 0.9 * t, t), "x", 90)
        outline = [
            (-6, 0),
            (-6, s * 9),
            (0.3 * jaw, s * 9),
            (jaw, s * 4),
            (jaw, s * 0.7),
            (0, s * 0.7),
        ]
        thing += move(prism(outline, 2 * t - 1), z=-t + 0.5)
    return thing


def tongs(draw: Draw) -> Thing:
    """Tongs, tweezers or a clothes peg: two arms that meet at one end."""
    length = draw(60, 200)
    wide = draw(4, 12)
    gap = draw(6, 24)
    t = draw(2, 4)
    bend = arc((gap + 4, gap), 90, 270, 9, (0, 0, 0))
    line = np.concatenate(
        [
            [(length, 0, 0.4 * gap + t), (0.6 * length, 0, gap)],
            bend,
            [(0.6 * length, 0, -gap), (length, 0, -0.4 * gap - t)],
        ]
    )
    return turn(path(line, t, wide, sides=4), "x", 90)


def stapler(draw: Draw) -> Thing:
    """A stapler or a hole punch: a base and a jaw that rises from its hinge."""
    length = draw(80, 170)
    wide = draw(20, 42)
    rise = draw(6, 20)
    t = draw(8, 16)
    jaw = turn(move(slab(0.95 * length, 0.85 * wide, 1.3 * t, 4, 2), x=0.475 * length), "y", -rise)
    hinge = box(0.18 * length, 0.8 * wide, 1.6 * t, (0.08 * length, 0, 1))
    return move(slab(length, wide, t, 5, 1.5), x=length / 2) + move(jaw, z=0.8 * t + 1) + hinge


def iron(draw: Draw) -> Thing:
    """A flat iron, a stamp or a trowel: a pointed sole with a handle over it."""
    x = draw(90, 170)
    y = draw(45, 85)
    z = draw(14, 30)
    rise = draw(28, 45)
    outline = [
        (-x / 2, -y / 2),
        (0.05 * x, -y / 2),
        (0.35 * x, -0.25 * y),
        (x / 2, 0),
        (0.35 * x, 0.25 * y),
        (0.05 * x, y / 2),
        (-x / 2, y / 2),
    ]
    handle = path(arc((0.36 * x, rise), -6, 186, 9, (-0.06 * x, 0, z)), draw(5, 8), draw(6, 11))
    return prism(outline, z, draw(0.75, 1.0)) + handle


def trolley(draw: Draw) -> Thing:
    """A box or a lunch case with an arched grip on its top."""
    x = draw(60, 170)
    y = draw(30, 80)
    z = draw(40, 110)
    grip = path(
        arc((draw(0.22, 0.4) * x, draw(22, 45)), -5, 185, 11, (0, 0, z)), draw(3, 6), draw(4, 10)
    )
    return slab(x, y, z, 6, 3) + grip


def dryer(draw: Draw) -> Thing:
    """A hair dryer, a drill or a toy pistol: a barrel with a grip across, lying."""
    r = draw(18, 36)
    length = draw(90, 170)
    grip = draw(70, 110)
    lean = draw(60, 105)
    barrel = turn(
        stack([(0.8 * r, 0), (r, 0.15 * length), (r, 0.5 * length), (draw(0.45, 0.9) * r, length)]),
        "y",
        90,
    )
    a = math.radians(lean)
    at = (0.25 * length, 0.0, 0.0)
    end = (at[0] - (grip + r) * math.cos(a), -(grip + r) * math.sin(a), 0.0)
    return barrel + rod(at, end, 0.5 * r, draw(0.45, 0.65) * r)


def bell(draw: Draw) -> Thing:
    """A hand bell, a stamp or a plunger: a grip on a wide, hollow foot."""
    r = draw(22, 48)
    h = draw(25, 55)
    wall = draw(2, 5)
    grip = draw(40, 90)
    mouth = move(
        turn(vessel([(0.4 * r, 0), (0.6 * r, 0.4 * h), (r, h)], wall, wall + 2), "x", 180), z=h
    )
    knob = draw(7, 14)
    return mouth + stack(
        [
            (0.35 * knob + 3, h - 2),
            (0.6 * knob, h + 8),
            (knob, h + 0.7 * grip),
            (0.7 * knob, h + grip),
        ]
    )


def racket(draw: Draw) -> Thing:
    """A paddle, a hand mirror or a magnifier: a filled or open round head on a handle."""
    r = draw(24, 65)
    h = draw(6.5, 12)
    handle = draw(60, 110)
    if draw(0, 1) < 0.5:
        head = stack([(r, -h / 2), (r, h / 2)], draw(0.75, 1.0))
    else:
        head = turn(
            path(
                arc((r - 4, (r - 4) * draw(0.75, 1.0)), 0, 345, 24, (0, 0, 0)),
                4,
                h / 2,
                closed=True,
            ),
            "x",
            90,
        )
    return head + rod((r - 4, 0, 0), (r + handle, 0, 0), 0.42 * h + 1, draw(4, 10))


def whisk(draw: Draw) -> Thing:
    """A whisk or a cage: wire bows that cross on a handle, lying."""
    r = draw(18, 34)
    tall = draw(35, 60)
    wire = draw(2, 3)
    grip = draw(70, 120)
    count = int(draw(2, 4))
    bows = around(path(arc((r, tall), -55, 235, 11, (0, 0, 0)), wire), count, 180)
    start = -tall * math.sin(math.radians(55))
    return turn(bows + stack([(0.5 * r, start - grip), (0.65 * r, start + 4)]), "x", 90)


def hanger(draw: Draw) -> Thing:
    """A triangular frame with a hook, lying: a hanger, a set square, a carabiner."""
    x = draw(60, 110)
    z = draw(40, 80)
    wire = draw(3, 6)
    ends = [(-x, 0, 0), (x, 0, 0), (0, 0, z)]
    frame = join(
        rod(ends[k - 1], ends[k], wire) + pebble(1.3 * wire, 1.2 * wire, 1.3 * wire, ends[k])
        for k in range(3)
    )
    r = draw(10, 18)
    bow = path(arc(r, 190, -90, 10, (0, 0, z + 4 + r)), 0.7 * wire)
    return turn(frame + bow + rod((0, 0, z - 2), (0, 0, z + 6), wire), "x", 90)


def key(draw: Draw) -> Thing:
    """A large key, a valve or a tap: a ring or a disc, a shaft, teeth at its end."""
    r = draw(14, 28)
    h = draw(6.5, 12)
    shaft = draw(40, 90)
    loop = turn(
        path(arc((r, 0.85 * r), 0, 337.5, 16, (0, 0, 0)), 0.45 * h + 1, h / 2, closed=True), "x", 90
    )
    bits = [(at * shaft, draw(8, 22)) for at in (0.7, 0.92)]
    teeth = join(box(draw(5, 9), tall, 0.7 * h, (r + at, tall / 2, -0.35 * h)) for at, tall in bits)
    return loop + rod((r - 1, 0, 0), (r + shaft, 0, 0), 0.42 * h) + teeth


def watering(draw: Draw) -> Thing:
    """A watering can: a hollow drum with a long spout and a handle behind."""
    r = draw(30, 52)
    h = draw(55, 100)
    wall = draw(2.5, 5)
    spout = draw(50, 80)
    handle = path(
        arc((draw(24, 36), 0.4 * h), -88, 88, 9, (r - 0.6 * wall, 0, 0.5 * h)), 4, draw(4, 8)
    )
    tube = rod(
        (-r + 0.5 * wall + 3, 0, 0.2 * h), (-r - spout, 0, draw(0.9, 1.3) * h), draw(7, 11), 6
    )
    return vessel([(r, 0), (r, h)], wall, 4) + handle + tube


IMPLEMENTS = (
    spatula,
    spoon,
    fork,
    comb,
    knife,
    brush,
    broad,
    hammer,
    axe,
    screwdriver,
    torch,
    wrench,
    scissors,
    pliers,
    tongs,
    stapler,
    iron,
    trolley,
    dryer,
    bell,
    racket,
    whisk,
    hanger,
    key,
    watering,
)
"""Families of this file. New ones come last."""
