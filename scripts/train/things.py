"""Flat, long and jointed things of a household: boxes, books, devices, pens, frames. Lengths are in
mm.

Each function makes one body of its family; `draw` draws its sizes. Tall things stand, long and flat
ones lie.
"""

import math

import numpy as np

from train.solids import (
    Draw,
    Thing,
    arc,
    box,
    disc,
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
)


def carton(draw: Draw) -> Thing:
    """A box of any proportions, standing on any side."""
    return box(draw(20, 130), draw(20, 110), draw(20, 190))


def gable(draw: Draw) -> Thing:
    """A carton with a roof and a crest, as of milk; or a house."""
    x = draw(45, 95)
    y = draw(45, 95)
    h = draw(60, 170)
    roof = draw(15, 45)
    ridge = [(s * x / 2, t * y / 2, h) for s in (-1, 1) for t in (-1, 1)] + [
        (s * x / 2, 0, h + roof) for s in (-1, 1)
    ]
    return (
        box(x, y, h)
        + lump(np.array(ridge))
        + box(0.98 * x, 4, draw(5, 15), (0, 0, h + 0.85 * roof))
    )


def plank(draw: Draw) -> Thing:
    """A bar of rectangular section that lies."""
    return box(draw(60, 248), draw(10, 60), draw(8, 40))


def flat(draw: Draw) -> Thing:
    """A thin, wide box that lies: a case, a stack of cards or paper, a tile."""
    return slab(draw(45, 200), draw(35, 140), draw(6, 25), draw(1, 8), draw(0.3, 2))


def book(draw: Draw) -> Thing:
    """A book with covers that stand out over its pages, lying or standing."""
    x = draw(70, 170)
    y = draw(100, 230)
    z = draw(10, 50)
    cover = draw(2, 3.5)
    pages = box(x - 8, y - 8, z - 1, (3, 0, 0.5))
    spine = box(cover + 1, y, z, ((x - cover - 1) / 2, 0, 0))
    covers = box(x, y, cover) + box(x, y, cover, (0, 0, z - cover))
    return turn(pages + spine + covers, "x", 90 if draw(0, 1) < 0.3 else 0)


def soap(draw: Draw) -> Thing:
    """A bar with large round edges: soap, a sponge, a loaf."""
    x = draw(45, 180)
    y = draw(35, 90)
    z = draw(16, 65)
    return slab(x, y, z, draw(0.2, 0.45) * min(x, y), draw(0.15, 0.4) * z)


def phone(draw: Draw) -> Thing:
    """A telephone that lies on its back, or on its glass with the camera up."""
    x = draw(55, 85)
    y = draw(100, 170)
    z = draw(7, 14)
    camera = move(slab(0.35 * x, 0.35 * x, z + 3, 5, 1), -0.25 * x, 0.28 * y)
    return slab(x, y, z, draw(4, 12), draw(0.5, 2.5)) + camera


def remote(draw: Draw) -> Thing:
    """A remote control with raised keys."""
    x = draw(30, 60)
    y = draw(100, 220)
    z = draw(12, 30)
    rows = [at for at in np.arange(-0.38, 0.4, draw(0.12, 0.3))]
    keys = [solid for at in rows for solid in box(draw(0.4, 0.7) * x, 7, z + 2, (0, at * y, 0))]
    return slab(x, y, z, draw(3, 12), draw(1, 4)) + keys


def mouse(draw: Draw) -> Thing:
    """A low dome on a flat base: a computer mouse, a bun, half a fruit."""
    x = draw(26, 42)
    y = draw(30, 65)
    z = draw(22, 55)
    return stack(
        [
            (x, 0),
            *[(x * math.cos(t), 0.15 * z + 0.85 * z * math.sin(t)) for t in np.linspace(0, 1.4, 7)],
        ],
        y / x,
    )


def stick(draw: Draw) -> Thing:
    """A round or edged rod that lies, some with a taper: a candle, chalk, a dowel."""
    r = draw(3.6, 16)
    sides = 6 if draw(0, 1) < 0.3 else 24
    return turn(stack([(r, 0), (r * draw(0.7, 1.0), draw(60, 245))], sides=sides), "x", 90)


def pen(draw: Draw) -> Thing:
    """A pen with a tip and a clip, lying."""
    r = draw(3.6, 7)
    length = draw(110, 170)
    tip = draw(10, 25)
    body = stack([(1.2, 0), (r, tip), (r, length), (0.8 * r, length + 2)], sides=12)
    return turn(body + box(2.5, 0.8 * r + 2, 35, (0, r / 2, length - 38)), "x", 90)


def marker(draw: Draw) -> Thing:
    """A marker or a lipstick with a thicker cap, lying or standing on it."""
    r = draw(7, 14)
    length = draw(50, 110)
    cap = draw(25, 45)
    outline = [
        (draw(1.05, 1.25) * r, 0),
        (1.2 * r, cap),
        (r, cap),
        (r, cap + length),
        (0.9 * r, cap + length + 3),
    ]
    return turn(stack(outline), "x", 0 if draw(0, 1) < 0.3 else 90)


def glasses(draw: Draw) -> Thing:
    """A pair of glasses with open arms, its rims filled or open."""
    wide = draw(22, 28)
    tall = draw(14, 22)
    bridge = draw(14, 22)
    t = draw(2.5, 4)
    arm = draw(70, 130)
    thing = rod((0, -bridge / 2 - 3, tall * 1.4), (0, bridge / 2 + 3, tall * 1.4), t)
    for s in (-1, 1):
        loop = arc((wide, tall), 0, 337.5, 16, (s * (wide + bridge / 2), 0, tall + t))
        rim = turn(path(loop, 0.8 * t, t, closed=True), "z", 90)
        lens = turn(turn(prism(disc(wide, tall, 0)[:, :2], 2), "x", 90), "z", 90)
        side = s * (2 * wide + bridge / 2)
        line = np.array(
            [
                (t - 2, side, 1.4 * tall),
                (-0.7 * arm, side, 1.4 * tall),
                (-arm, 0.98 * side, 0.4 * tall),
            ]
        )
        thing += (
            rim
            + move(lens, -1, s * (wide + bridge / 2), tall + t) * int(draw(0, 2))
            + path(line, t, 0.8 * t)
        )
    return thing


def watch(draw: Draw) -> Thing:
    """A watch or a bracelet: a closed band with a dial, standing on its edge or lying on it."""
    r = draw(22, 36)
    wide = draw(5, 14)
    t = draw(1.5, 3)
    band = path(arc((r, 0.85 * r), 0, 345, 24, (0, 0, 0)), t, wide, closed=True)
    dial = move(
        stack([(draw(1.1, 1.8) * wide + 5, 0), (draw(1.1, 1.7) * wide + 4, draw(7, 13))]),
        z=0.85 * r - 3,
    )
    return turn(band + dial, "x", 90 if draw(0, 1) < 0.5 else 0)


def hook(draw: Draw) -> Thing:
    """A bent rod that lies: a hook, a cane, a horseshoe, a clamp."""
    r = draw(12, 40)
    wide = draw(3.5, 9)
    bend = draw(120, 260)
    leg = draw(20, 110)
    line = arc(r + wide, 0, bend, 11, (0, 0, 0))
    line = np.concatenate([[(r + wide, 0, -leg)], line])
    return turn(
        path(line, wide, wide * draw(0.8, 1.5), sides=12 if draw(0, 1) < 0.6 else 4), "x", 90
    )


def padlock(draw: Draw) -> Thing:
    """A lock with a shackle, lying; or a purse, a kettle bell."""
    x = draw(35, 70)
    y = draw(14, 28)
    z = draw(30, 60)
    rod_r = draw(3.5, 6)
    rise = draw(15, 40)
    line = arc((x / 2 - rod_r - 4, rise), 0, 180, 11, (0, 0, z - 2))
    body = slab(x, y, z, draw(2, 0.4 * y), 2)
    return turn(body + path(line, rod_r), "x", 90 if draw(0, 1) < 0.6 else 0)


def plug(draw: Draw) -> Thing:
    """An adapter: a block with two or three pins, which lies on its side."""
    x = draw(35, 65)
    y = draw(30, 50)
    z = draw(25, 55)
    pin = draw(2.5, 4)
    pins = [
        rod((at, s * 0.1 * y, z - 3), (at, s * 0.1 * y, z + draw(15, 20)), pin)
        for at, s in ((-9, 1), (9, 1), (0, -2))
    ]
    return turn(slab(x, y, z, draw(3, 12), 2) + join(pins[: int(draw(2, 4))]), "x", 90)


def camera(draw: Draw) -> Thing:
    """A camera or a projector: a box with a lens at its front and a hump above."""
    x = draw(60, 125)
    y = draw(25, 55)
    z = draw(45, 85)
    lens = turn(stack([(0.36 * z, 0), (draw(0.28, 0.4) * z, y / 2 + draw(10, 50))]), "x", 90)
    return (
        slab(x, y, z, 5, 3)
        + move(lens, draw(-0.15, 0.15) * x, 0, z / 2)
        + box(0.35 * x, 0.6 * y, z + draw(6, 14))
    )


def clock(draw: Draw) -> Thing:
    """An alarm clock: a short drum on its edge with two feet and two bells or a handle."""
    r = draw(25, 55)
    depth = draw(22, 45)
    drum = move(turn(stack([(r, -depth / 2), (r, depth / 2)]), "x", 90), z=r + 6)
    feet = [box(10, 0.8 * depth, 0.6 * r, (s * 0.55 * r, 0, 0)) for s in (-1, 1)]
    bells = [pebble(0.4 * r, 0.35 * r, 0.3 * r, (s * 0.6 * r, 0, 1.85 * r + 6)) for s in (-1, 1)]
    bow = path(arc((0.55 * r, draw(0.5, 0.9) * r), 0, 180, 9, (0, 0, 1.7 * r + 6)), 4, 5)
    return drum + feet[0] + feet[1] + (bells[0] + bells[1] if draw(0, 1) < 0.5 else bow)


def spray(draw: Draw) -> Thing:
    """A bottle with a trigger head or a pump."""
    r = draw(24, 42)
    h = draw(80, 160)
    neck = draw(9, 13)
    body = stack(
        [(0.95 * r, 0), (r, 6), (r, 0.7 * h), (0.75 * r, 0.88 * h), (neck, h), (neck, h + 20)],
        draw(0.6, 1.0),
    )
    if draw(0, 1) < 0.4:
        spout = path(
            np.array([(-8, 0, h + 44), (18, 0, h + 46), (draw(32, 48), 0, h + 38)]), 5, draw(5, 9)
        )
        return body + rod((0, 0, h + 10), (0, 0, h + 44), 5) + spout
    head = box(draw(52, 80), draw(18, 26), draw(18, 28), (10, 0, h + 16))
    trigger = path(
        np.array([(22, 0, h + 20), (26, 0, h + 2), (38, 0, h - draw(8, 22))]), 4, draw(5, 8)
    )
    return body + head + trigger + rod((30, 0, h + 26), (draw(52, 62), 0, h + 26), 6)


THINGS = (
    carton,
    gable,
    plank,
    flat,
    book,
    soap,
    phone,
    remote,
    mouse,
    stick,
    pen,
    marker,
    glasses,
    watch,
    hook,
    padlock,
    plug,
    camera,
    clock,
    spray,
)
"""Families of this file. New ones come last."""
