"""Simple forms and toys of a household: blocks, prisms, extrusions, forms that run into each other.
Lengths are in mm.

Each function makes one body of its family. Its table draws the first sizes, `draw` the others.
"""

import math

import numpy as np

from train.solids import (
    Draw,
    Families,
    Thing,
    around,
    ball,
    box,
    disc,
    family,
    join,
    lie,
    lump,
    move,
    pebble,
    prism,
    rod,
    slab,
    stack,
    tip,
    turn,
)

FORMS: Families = {}
"""The families of this file by name. New ones come last."""


@family(FORMS, a=(15, 75))
def cube(draw: Draw, a: float) -> Thing:
    """A block about as high as wide, with cut edges."""
    x, y, z = (a * draw(0.8, 1.2) for _ in range(3))
    return slab(x, y, z, draw(0.03, 0.25) * min(x, y), draw(0.02, 0.15) * z)


@family(FORMS, many=(3, 9), r=(16, 60))
def column(draw: Draw, many: float, r: float) -> Thing:
    """A prism of three to eight sides, some with a narrower top."""
    count = int(many)
    outline = disc(r, r * draw(0.6, 1.0), 0, count)[:, :2]
    return tip(draw, prism(outline, draw(20, 170), draw(0.6, 1.0)), 0.4)


@family(FORMS)
def pyramid(draw: Draw) -> Thing:
    """A pyramid or a cone with a blunt tip."""
    count = (3, 4, 4, 6, 24, 24)[int(draw(0, 6))]
    r = draw(25, 75)
    h = draw(30, 130)
    return stack([(r, 0), (r * draw(0.05, 0.4), h)], draw(0.7, 1.0), count)


@family(FORMS, x=(50, 160), y=(25, 80), low=(3, 10), high=(20, 75))
def wedge(draw: Draw, x: float, y: float, low: float, high: float) -> Thing:
    """A ramp with a blunt edge."""
    ends = [(s * x / 2, t * y / 2, top) for s, top in ((-1, low), (1, high)) for t in (-1, 1)]
    return lump(np.array([(at, side, z) for at, side, top in ends for z in (0, top)]))


@family(FORMS, x=(30, 95), z=(25, 95), depth=(12, 110), wall=(3, 14), sort=(0, 5))
def profile(draw: Draw, x: float, z: float, depth: float, wall: float, sort: float) -> Thing:
    """A piece of an extruded L, T, U, Z or H, on its foot or on its end."""
    kind = int(sort)
    left = -(x - wall) / 2
    right = (x - wall) / 2
    centre = 0.0
    upright = ((left,), (centre,), (left, right), (left,), (left, right))[kind]
    foot = [
        box(x, depth, wall),
        box(x, depth, wall, (0, 0, z - wall)),
        box(x, depth, wall, (0, 0, 0.5 * z)),
    ]
    top = box(x, depth, wall, (wall - x, 0, z - wall))
    webs = [solid for at in upright for solid in box(wall, depth, z, (at, 0, 0))]
    bars = (foot[0], foot[1], foot[0], foot[0] + top, foot[2])[kind]
    return tip(draw, webs + bars, 0.4)


@family(FORMS, many=(3, 7), reach=(25, 90), wide=(8, 24), h=(8, 45))
def cross(draw: Draw, many: float, reach: float, wide: float, h: float) -> Thing:
    """A plus or a star of three to six arms, lying or standing."""
    count = int(many)
    arms = around(box(reach, wide, h, (reach / 2, 0, 0)), count)
    hub = stack([(wide, 0), (wide, h + draw(0, 6) + 0.5)])
    return tip(draw, arms + hub, 0.4)


@family(FORMS)
def stone(draw: Draw) -> Thing:
    """A stone: the hull of random points."""
    size = [draw(14, 60) for _ in range(3)]
    points = np.array([[draw(-1, 1) for _ in range(3)] for _ in range(24)])
    return lump(points / np.linalg.norm(points, axis=1, keepdims=True) * size)


@family(FORMS)
def blocks(draw: Draw) -> Thing:
    """Two to four boxes and bars that run into each other."""
    first = [draw(25, 80) for _ in range(3)]
    thing = box(first[0], first[1], first[2])
    for _ in range(int(draw(1, 4))):
        x, y, z = (draw(0.25, 1.1) * edge for edge in first)
        side = (draw(-0.5, 0.5) * first[0], draw(-0.5, 0.5) * first[1], draw(0.1, 0.9) * first[2])
        turned = draw(0, 90)
        solid = box(x, y, z) if draw(0, 1) < 0.6 else stack([(x / 2, 0), (x / 2, z)])
        thing += move(turn(solid, "z", turned), *side)
    return thing


@family(FORMS, r=(15, 38))
def bubbles(draw: Draw, r: float) -> Thing:
    """Two to four ellipsoids that run into each other: a toy, a root of ginger, a potato."""
    thing = ball(r, r * draw(0.7, 1.3), r * draw(0.7, 1.2), 6)
    for _ in range(int(draw(1, 4))):
        a = draw(0.4, 0.9) * r
        angle = draw(0, 6.28)
        tilt = draw(-0.6, 1.2)
        level = math.cos(tilt)
        way = np.array([math.cos(angle) * level, math.sin(angle) * level, math.sin(tilt)])
        at = way * r * 0.9
        thing += move(ball(a, a * draw(0.7, 1.3), a * draw(0.7, 1.3), 6), *at.tolist())
    return thing


@family(FORMS, r=(20, 42), head=(0.5, 0.75))
def duck(draw: Draw, r: float, head: float) -> Thing:
    """An animal of rubber: a body, a head, a beak, ears or a tail."""
    thing = ball(r * draw(1.0, 1.5), r, 0.85 * r)
    thing += move(ball(head * r, head * r, head * r), 0.6 * r, 0, 1.2 * r)
    thing += pebble(0.35 * r, 0.25 * r, 0.15 * r, ((0.6 + head) * r, 0, 1.15 * r))
    thing += pebble(0.45 * r, 0.3 * r, 0.25 * r, (-1.1 * r, 0, 0.35 * r))
    tall = draw(0.2, 0.7) * r
    ears = [
        pebble(0.18 * r, 0.2 * r, tall, (0.5 * r, s * 0.5 * head * r, (1.1 + head) * r))
        for s in (-1, 1)
    ]
    return thing + (ears[0] + ears[1] if draw(0, 1) < 0.5 else [])


@family(FORMS, x=(50, 120), y=(24, 50), z=(12, 28), wheel=(7, 14))
def car(draw: Draw, x: float, y: float, z: float, wheel: float) -> Thing:
    """A toy car: a body, a cabin and four wheels."""
    body = box(x, y, z, (0, 0, 0.6 * wheel))
    cabin = slab(0.5 * x, 0.85 * y, z, 4, 3)
    body += move(cabin, draw(-0.15, 0.1) * x, 0, 0.5 * wheel + z)
    rims = [lie(stack([(wheel, -y / 2 - 3), (wheel, y / 2 + 3)], sides=16)) for _ in (0, 1)]
    return body + move(rims[0], -0.32 * x, 0, wheel) + move(rims[1], 0.32 * x, 0, wheel)


@family(FORMS, r=(25, 75), h=(30, 120), top=(5, 14), leg=(4, 8), many=(3, 5))
def stool(draw: Draw, r: float, h: float, top: float, leg: float, many: float) -> Thing:
    """A small table of three or four legs, some upside down."""
    count = int(many)
    legs = around(rod((1.0 * r - 8, 0, 0), (0.7 * r - 8, 0, h), leg, 0.9 * leg), count)
    return tip(draw, legs + move(stack([(r, 0), (r, top)]), z=h - 2), 0.3, 180)


@family(FORMS, long=(2, 6), across=(1, 4), gap=(18, 36), base=(6, 16))
def pegs(draw: Draw, long: float, across: float, gap: float, base: float) -> Thing:
    """A board with a row or a field of pegs."""
    nx = int(long)
    ny = int(across)
    r = draw(0.18, 0.35) * gap
    h = draw(12, 60)
    places = [
        ((i - (nx - 1) / 2) * gap, (j - (ny - 1) / 2) * gap) for i in range(nx) for j in range(ny)
    ]
    rods = join(
        move(stack([(r, 0), (r * draw(0.6, 1.0), h)], sides=12), x, y, base - 1) for x, y in places
    )
    return box(nx * gap, max(ny * gap, 24), base) + rods


@family(FORMS, r=(20, 70), h=(8, 30), many=(5, 13))
def gear(draw: Draw, r: float, h: float, many: float) -> Thing:
    """A wheel with teeth or spokes, lying or standing on its rim."""
    count = int(many)
    tooth = prism(
        [(0.9 * r, -0.15 * r), (1.2 * r, -0.1 * r), (1.2 * r, 0.1 * r), (0.9 * r, 0.15 * r)],
        0.9 * h,
    )
    wheel = prism(disc(r, r, 0)[:, :2], h) + stack([(0.4 * r, 0), (0.35 * r, h + draw(1, 20))])
    return tip(draw, wheel + around(tooth, count), 0.3)
