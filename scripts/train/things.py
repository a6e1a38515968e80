"""Flat, long and jointed things of a household: boxes, books, devices, pens, frames. Lengths are in
mm.

Each function makes one body of its family. Its table draws the first sizes, `draw` the others.
Tall things stand, long and flat ones lie.
"""

import math

import numpy as np

from train.solids import (
    Draw,
    Families,
    Thing,
    arc,
    box,
    disc,
    family,
    join,
    lie,
    lump,
    move,
    path,
    pebble,
    prism,
    rod,
    slab,
    stack,
    tip,
    turn,
)

THINGS: Families = {}
"""The families of this file by name. New ones come last."""


@family(THINGS)
def carton(draw: Draw) -> Thing:
    """A box of any proportions, standing on any side."""
    return box(draw(20, 130), draw(20, 110), draw(20, 190))


@family(THINGS, x=(45, 95), y=(45, 95), h=(60, 170), roof=(15, 45))
def gable(draw: Draw, x: float, y: float, h: float, roof: float) -> Thing:
    """A carton with a roof and a crest, as of milk; or a house."""
    ridge = [(s * x / 2, t * y / 2, h) for s in (-1, 1) for t in (-1, 1)]
    ridge += [(s * x / 2, 0, h + roof) for s in (-1, 1)]
    house = box(x, y, h) + lump(np.array(ridge))
    return house + box(0.98 * x, 4, draw(5, 15), (0, 0, h + 0.85 * roof))


@family(THINGS)
def plank(draw: Draw) -> Thing:
    """A bar of rectangular section that lies."""
    return box(draw(60, 248), draw(10, 60), draw(8, 40))


@family(THINGS)
def flat(draw: Draw) -> Thing:
    """A thin, wide box that lies: a case, a stack of cards or paper, a tile."""
    return slab(draw(45, 200), draw(35, 140), draw(6, 25), draw(1, 8), draw(0.3, 2))


@family(THINGS, x=(70, 170), y=(100, 230), z=(10, 50), cover=(2, 3.5))
def book(draw: Draw, x: float, y: float, z: float, cover: float) -> Thing:
    """A book with covers that stand out over its pages, lying or standing."""
    pages = box(x - 8, y - 8, z - 1, (3, 0, 0.5))
    spine = box(cover + 1, y, z, ((x - cover - 1) / 2, 0, 0))
    covers = box(x, y, cover) + box(x, y, cover, (0, 0, z - cover))
    return tip(draw, pages + spine + covers, 0.3)


@family(THINGS, x=(45, 180), y=(35, 90), z=(16, 65))
def soap(draw: Draw, x: float, y: float, z: float) -> Thing:
    """A bar with large round edges: soap, a sponge, a loaf."""
    return slab(x, y, z, draw(0.2, 0.45) * min(x, y), draw(0.15, 0.4) * z)


@family(THINGS, x=(55, 85), y=(100, 170), z=(7, 14))
def phone(draw: Draw, x: float, y: float, z: float) -> Thing:
    """A telephone that lies on its back, or on its glass with the camera up."""
    camera = move(slab(0.35 * x, 0.35 * x, z + 3, 5, 1), -0.25 * x, 0.28 * y)
    return slab(x, y, z, draw(4, 12), draw(0.5, 2.5)) + camera


@family(THINGS, x=(30, 60), y=(100, 220), z=(12, 30))
def remote(draw: Draw, x: float, y: float, z: float) -> Thing:
    """A remote control with raised keys."""
    rows = [at for at in np.arange(-0.38, 0.4, draw(0.12, 0.3))]
    keys = [solid for at in rows for solid in box(draw(0.4, 0.7) * x, 7, z + 2, (0, at * y, 0))]
    return slab(x, y, z, draw(3, 12), draw(1, 4)) + keys


@family(THINGS, x=(26, 42), y=(30, 65), z=(22, 55))
def mouse(draw: Draw, x: float, y: float, z: float) -> Thing:
    """A low dome on a flat base: a computer mouse, a bun, half a fruit."""
    angles = np.linspace(0, 1.4, 7)
    dome = [(x * math.cos(t), 0.15 * z + 0.85 * z * math.sin(t)) for t in angles]
    return stack([(x, 0), *dome], y / x)


@family(THINGS, r=(3.6, 16))
def stick(draw: Draw, r: float) -> Thing:
    """A round or edged rod that lies, some with a taper: a candle, chalk, a dowel."""
    sides = 6 if draw(0, 1) < 0.3 else 24
    return lie(stack([(r, 0), (r * draw(0.7, 1.0), draw(60, 245))], sides=sides))


@family(THINGS, r=(3.6, 7), length=(110, 170), tip=(10, 25))
def pen(draw: Draw, r: float, length: float, tip: float) -> Thing:
    """A pen with a tip and a clip, lying."""
    body = stack([(1.2, 0), (r, tip), (r, length), (0.8 * r, length + 2)], sides=12)
    return lie(body + box(2.5, 0.8 * r + 2, 35, (0, r / 2, length - 38)))


@family(THINGS, r=(7, 14), length=(50, 110), cap=(25, 45))
def marker(draw: Draw, r: float, length: float, cap: float) -> Thing:
    """A marker or a lipstick with a thicker cap, lying or standing on it."""
    outline = [(draw(1.05, 1.25) * r, 0), (1.2 * r, cap), (r, cap)]
    outline += [(r, cap + length), (0.9 * r, cap + length + 3)]
    return turn(stack(outline), "x", 0 if draw(0, 1) < 0.3 else 90)


@family(THINGS, wide=(22, 28), tall=(14, 22), bridge=(14, 22), t=(2.5, 4), arm=(70, 130))
def glasses(draw: Draw, wide: float, tall: float, bridge: float, t: float, arm: float) -> Thing:
    """A pair of glasses with open arms, its rims filled or open."""
    thing = rod((0, -bridge / 2 - 3, tall * 1.4), (0, bridge / 2 + 3, tall * 1.4), t)
    for s in (-1, 1):
        loop = arc((wide, tall), 0, 337.5, 16, (s * (wide + bridge / 2), 0, tall + t))
        rim = turn(path(loop, 0.8 * t, t, closed=True), "z", 90)
        lens = turn(lie(prism(disc(wide, tall, 0)[:, :2], 2)), "z", 90)
        side = s * (2 * wide + bridge / 2)
        straight = [(t - 2, side, 1.4 * tall), (-0.7 * arm, side, 1.4 * tall)]
        line = np.array([*straight, (-arm, 0.98 * side, 0.4 * tall)])
        glass = move(lens, -1, s * (wide + bridge / 2), tall + t) * int(draw(0, 2))
        thing += rim + glass + path(line, t, 0.8 * t)
    return thing


@family(THINGS, r=(22, 36), wide=(5, 14), t=(1.5, 3))
def watch(draw: Draw, r: float, wide: float, t: float) -> Thing:
    """A watch or a bracelet: a closed band with a dial, standing on its edge or lying on it."""
    band = path(arc((r, 0.85 * r), 0, 345, 24, (0, 0, 0)), t, wide, closed=True)
    dial = stack([(draw(1.1, 1.8) * wide + 5, 0), (draw(1.1, 1.7) * wide + 4, draw(7, 13))])
    return tip(draw, band + move(dial, z=0.85 * r - 3), 0.5)


@family(THINGS, r=(12, 40), wide=(3.5, 9), bend=(120, 260), leg=(20, 110))
def hook(draw: Draw, r: float, wide: float, bend: float, leg: float) -> Thing:
    """A bent rod that lies: a hook, a cane, a horseshoe, a clamp."""
    line = arc(r + wide, 0, bend, 11, (0, 0, 0))
    line = np.concatenate([[(r + wide, 0, -leg)], line])
    return lie(path(line, wide, wide * draw(0.8, 1.5), sides=12 if draw(0, 1) < 0.6 else 4))


@family(THINGS, x=(35, 70), y=(14, 28), z=(30, 60), rod_r=(3.5, 6), rise=(15, 40))
def padlock(draw: Draw, x: float, y: float, z: float, rod_r: float, rise: float) -> Thing:
    """A lock with a shackle, lying; or a purse, a kettle bell."""
    line = arc((x / 2 - rod_r - 4, rise), 0, 180, 11, (0, 0, z - 2))
    body = slab(x, y, z, draw(2, 0.4 * y), 2)
    return tip(draw, body + path(line, rod_r), 0.6)


@family(THINGS, x=(35, 65), y=(30, 50), z=(25, 55), pin=(2.5, 4))
def plug(draw: Draw, x: float, y: float, z: float, pin: float) -> Thing:
    """An adapter: a block with two or three pins, which lies on its side."""
    pins = [
        rod((at, s * 0.1 * y, z - 3), (at, s * 0.1 * y, z + draw(15, 20)), pin)
        for at, s in ((-9, 1), (9, 1), (0, -2))
    ]
    return lie(slab(x, y, z, draw(3, 12), 2) + join(pins[: int(draw(2, 4))]))


@family(THINGS, x=(60, 125), y=(25, 55), z=(45, 85))
def camera(draw: Draw, x: float, y: float, z: float) -> Thing:
    """A camera or a projector: a box with a lens at its front and a hump above."""
    lens = lie(stack([(0.36 * z, 0), (draw(0.28, 0.4) * z, y / 2 + draw(10, 50))]))
    body = slab(x, y, z, 5, 3) + move(lens, draw(-0.15, 0.15) * x, 0, z / 2)
    return body + box(0.35 * x, 0.6 * y, z + draw(6, 14))


@family(THINGS, r=(25, 55), depth=(22, 45))
def clock(draw: Draw, r: float, depth: float) -> Thing:
    """An alarm clock: a short drum on its edge with two feet and two bells or a handle."""
    drum = move(lie(stack([(r, -depth / 2), (r, depth / 2)])), z=r + 6)
    feet = [box(10, 0.8 * depth, 0.6 * r, (s * 0.55 * r, 0, 0)) for s in (-1, 1)]
    bells = [pebble(0.4 * r, 0.35 * r, 0.3 * r, (s * 0.6 * r, 0, 1.85 * r + 6)) for s in (-1, 1)]
    bow = path(arc((0.55 * r, draw(0.5, 0.9) * r), 0, 180, 9, (0, 0, 1.7 * r + 6)), 4, 5)
    return drum + feet[0] + feet[1] + (bells[0] + bells[1] if draw(0, 1) < 0.5 else bow)


@family(THINGS, r=(24, 42), h=(80, 160), neck=(9, 13))
def spray(draw: Draw, r: float, h: float, neck: float) -> Thing:
    """A bottle with a trigger head or a pump."""
    body = stack(
        [(0.95 * r, 0), (r, 6), (r, 0.7 * h), (0.75 * r, 0.88 * h), (neck, h), (neck, h + 20)],
        draw(0.6, 1.0),
    )
    if draw(0, 1) < 0.4:
        line = np.array([(-8, 0, h + 44), (18, 0, h + 46), (draw(32, 48), 0, h + 38)])
        spout = path(line, 5, draw(5, 9))
        return body + rod((0, 0, h + 10), (0, 0, h + 44), 5) + spout
    head = box(draw(52, 80), draw(18, 26), draw(18, 28), (10, 0, h + 16))
    line = np.array([(22, 0, h + 20), (26, 0, h + 2), (38, 0, h - draw(8, 22))])
    trigger = path(line, 4, draw(5, 8))
    return body + head + trigger + rod((30, 0, h + 26), (draw(52, 62), 0, h + 26), 6)
