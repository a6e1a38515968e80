"""Round and hollow things of a household: solids of revolution, and vessels with thin walls.
Lengths are in mm.
"""

import math

import numpy as np

from train.solids import (
    Draw,
    Profile,
    Thing,
    arc,
    ball,
    crate,
    lump,
    move,
    path,
    pebble,
    rod,
    shell,
    stack,
    turn,
    vessel,
)


def can(draw: Draw) -> Thing:
    """A tin with a rim that is cut or narrower."""
    r = draw(22, 52)
    h = draw(35, 180)
    edge = draw(1, 5)
    return stack([(draw(0.85, 0.97) * r, 0), (r, edge), (r, h - edge), (draw(0.85, 0.97) * r, h)])


def bottle(draw: Draw, oval: float = 1.0) -> Thing:
    """A bottle with a shoulder, a neck and a cap, some with a waist."""
    r = draw(20, 43)
    h = draw(100, 245)
    shoulder = draw(0.45, 0.7)
    neck = draw(0.28, 0.6)
    waist = draw(0.75, 0.95) if draw(0, 1) < 0.4 else 1.0
    top = shoulder + draw(0.08, 0.2)
    body = [(0.9 * r, 0), (r, 0.04 * h), (waist * r, 0.5 * shoulder * h), (r, shoulder * h)]
    body += [
        ((0.6 + 0.4 * neck) * r, (0.4 * shoulder + 0.6 * top) * h),
        (neck * r, top * h),
        (neck * r, 0.92 * h),
    ]
    return stack(body, oval) + move(
        stack([(1.15 * neck * r, 0), (1.05 * neck * r, 0.1 * h)], oval), z=0.9 * h
    )


def flask(draw: Draw) -> Thing:
    """An oval bottle, as of shampoo."""
    return bottle(draw, oval=draw(0.45, 0.8))


def jar(draw: Draw) -> Thing:
    """A filled jar with a lid."""
    r = draw(22, 48)
    h = draw(40, 150)
    neck = draw(0.7, 0.95)
    lid = (0.7 + 0.3 * draw(0, 1)) * r
    body = stack(
        [(0.92 * r, 0), (r, 0.05 * h), (r, 0.7 * h), (neck * lid, 0.82 * h), (neck * lid, 0.86 * h)]
    )
    return body + move(stack([(lid, 0), (lid, 0.1 * h), (0.95 * lid, 0.14 * h)]), z=0.86 * h)


def tub(draw: Draw) -> Thing:
    """A filled tub that is wider at its rim than at its foot, as of yoghurt."""
    r = draw(24, 65)
    h = draw(30, 115)
    lip = draw(1, 4)
    foot = draw(0.6, 0.9) * r
    return stack(
        [(foot, 0), (r, h - lip), (r + lip, h - lip), (r + lip, h)],
        draw(0.7, 1.0) if draw(0, 1) < 0.3 else 1,
    )


def turned(draw: Draw) -> Thing:
    """A turned piece of any profile: a chess piece, a knob, a candlestick."""
    count = int(draw(4, 10))
    h = draw(30, 180)
    r = draw(12, 42)
    radii = [r * draw(0.3, 1.0) for _ in range(count)]
    radii[0] = r * draw(0.8, 1.1)
    return stack(list(zip(radii, np.linspace(0, h, count).tolist(), strict=True)), draw(0.7, 1.0))


def ellipsoid(draw: Draw) -> Thing:
    """A ball, or an egg or a pebble that lies on its shortest axis."""
    r = draw(11, 62)
    middle = draw(0.6, 1.0)
    return ball(r, r, r) if draw(0, 1) < 0.35 else ball(r, r * middle, r * middle * draw(0.6, 1.0))


def fruit(draw: Draw) -> Thing:
    """An apple, a pear, a lemon or a pepper, some with a stem; long ones lie."""
    r = draw(18, 48)
    tall = draw(0.8, 1.4)
    lean = draw(-0.4, 0.4)
    blunt = draw(0.6, 1.2)
    angle = np.linspace(math.pi - 0.25, 0.25, 10)
    radii = r * np.sin(angle) ** blunt * (1 + lean * np.cos(angle))
    body = stack(list(zip(radii, tall * r * np.cos(angle), strict=True)))
    stem = (
        rod((0, 0, 0.9 * tall * r), (4, 0, tall * r + draw(5, 15)), draw(2, 4))
        if draw(0, 1) < 0.5
        else []
    )
    return turn(body + stem, "x", 90 if tall > 1.15 else 0)


def banana(draw: Draw) -> Thing:
    """A bent, pointed fruit that lies on its side."""
    r = draw(11, 20)
    spread = draw(35, 65)
    share = np.linspace(-1, 1, 12)
    radius = r * np.sqrt(1.08 - share**2)
    line = arc(draw(80, 110), 270 - spread, 270 + spread, 12, (0, 0, 0))
    return turn(path(line, radius), "x", 90)


def mushroom(draw: Draw) -> Thing:
    """A stem with a wide, domed cap."""
    r = draw(16, 45)
    h = draw(25, 70)
    stem = draw(0.25, 0.6) * r
    rise = draw(0.5, 0.9) * r
    cap = [(r * math.cos(t), h + rise * math.sin(t)) for t in np.linspace(0, 1.35, 6)]
    return stack([(1.1 * stem, 0), (stem, h), (0.9 * r, h), *[(x, z + 1) for x, z in cap]])


def bulb(draw: Draw) -> Thing:
    """A light bulb that lies."""
    r = draw(16, 42)
    neck = draw(0.35, 0.55)
    base = draw(20, 35)
    angle = np.linspace(math.asin(neck), math.pi - 0.07, 8)
    glass = [(r * math.sin(t), base + 1.2 * r - r * math.cos(t)) for t in angle]
    return turn(stack([(0.6 * neck * r, 0), (neck * r, 4), (neck * r, base), *glass]), "x", 90)


def spool(draw: Draw) -> Thing:
    """A reel: two flanges and a core, standing or lying."""
    r = draw(14, 45)
    h = draw(20, 90)
    rim = draw(3, 8)
    core = draw(0.35, 0.8) * r
    pieces = stack([(r, 0), (r, rim), (core, rim), (core, h - rim), (r, h - rim), (r, h)])
    return turn(pieces, "x", 90 if draw(0, 1) < 0.5 else 0)


def dumbbell(draw: Draw) -> Thing:
    """Two heavy ends and a grip between them, lying."""
    r = draw(18, 45)
    end = draw(20, 55)
    grip = draw(50, 130)
    sides = 6 if draw(0, 1) < 0.5 else 24
    core = draw(0.3, 0.6) * r
    outline = [(0.8 * r, 0), (r, 0.2 * end), (r, end), (core, end), (core, end + grip)]
    outline += [(r, end + grip), (r, 1.8 * end + grip), (0.8 * r, 2 * end + grip)]
    return turn(stack(outline, sides=sides), "x", 90)


def pin(draw: Draw) -> Thing:
    """A rolling pin, a bat or a pestle: a thick rod with thinner ends, lying."""
    r = draw(9, 28)
    length = draw(60, 160)
    end = draw(15, 42)
    first = draw(0.3, 0.7) * r
    last = draw(0.3, 1.0) * r
    outline = [
        (first, 0),
        (first, end),
        (r, end + 0.1 * length),
        (draw(0.6, 1.0) * r, end + length),
    ]
    return turn(stack([*outline, (last, end + length), (last, 2 * end + length)]), "x", 90)


def lid(draw: Draw) -> Thing:
    """A lid with a knob."""
    r = draw(25, 95)
    h = draw(5, 18)
    knob = draw(7, 16)
    body = [(r, 0), (r, 3), (0.6 * r, h), (0.45 * knob, h), (0.45 * knob, h + 8)]
    return stack([*body, (knob, h + 12), (knob, h + 16), (0.7 * knob, h + 20)])


def ring(draw: Draw) -> Thing:
    """A round or oval ring that lies."""
    wide = draw(16, 80)
    r = draw(4, 15)
    line = arc((wide + r, (wide + r) * draw(0.6, 1.0)), 0, 345, 24, (0, 0, 0))
    return turn(path(line, r, r * draw(0.7, 1.5), closed=True), "x", 90)


def roll(draw: Draw) -> Thing:
    """A roll of tape or paper, or a piece of pipe: open at both ends, standing or lying."""
    r = draw(15, 60)
    h = draw(12, 120)
    hole = draw(0.35, 0.92)
    inner = min(hole * r, r - 1.5)
    return turn(shell([(r, inner, 0), (r, inner, h)]), "x", 90 if draw(0, 1) < 0.3 else 0)


def cup(draw: Draw) -> Thing:
    """A beaker without a handle, upright or upside down."""
    r = draw(22, 48)
    h = draw(45, 150)
    wall = draw(1, 5)
    outline = [(draw(0.6, 1.0) * r, 0), (draw(0.85, 1.0) * r, 0.5 * h), (r, h)]
    return turn(vessel(outline, wall, draw(2, 8)), "x", 180 if draw(0, 1) < 0.2 else 0)


def mug(draw: Draw) -> Thing:
    """A mug with a handle."""
    r = draw(28, 46)
    h = draw(60, 125)
    wall = draw(2.5, 5.5)
    foot = draw(0.75, 1.0) * r
    pieces = vessel([(foot, 0), (r, 0.45 * h), (r, h)], wall, draw(3, 7))
    reach = draw(18, 38)
    return pieces + _grip(
        r - 0.6 * wall, h * draw(0.48, 0.55), h * draw(0.8, 0.9), reach, draw(3, 5), draw(4, 9)
    )


def goblet(draw: Draw) -> Thing:
    """A glass on a stem."""
    r = draw(24, 45)
    bowl = draw(45, 100)
    stem = draw(30, 95)
    wall = draw(1.5, 3)
    foot = draw(0.75, 1.0) * r
    thin = draw(3.5, 7)
    up = vessel([(0.45 * r, 0), (r, 0.5 * bowl), (draw(0.75, 1.1) * r, bowl)], wall, 5)
    return stack([(foot, 0), (foot, 3), (thin, 9), (thin, stem - 6), (0.45 * r, stem)]) + move(
        up, z=stem
    )


def bowl(draw: Draw) -> Thing:
    """A bowl with a foot, upright or upside down, round or oval."""
    r = draw(38, 110)
    h = draw(28, 85)
    wall = draw(2, 6)
    foot = draw(0.35, 0.65) * r
    outline = [
        (foot, 0),
        (foot + 0.62 * (r - foot), 0.33 * h),
        (foot + 0.9 * (r - foot), 0.67 * h),
        (r, h),
    ]
    pieces = vessel(
        outline, wall, min(1.5 * wall, 0.2 * h), draw(0.65, 1.0) if draw(0, 1) < 0.3 else 1.0
    )
    return turn(pieces, "x", 180 if draw(0, 1) < 0.2 else 0)


def dish(draw: Draw) -> Thing:
    """A plate or a saucer."""
    r = draw(45, 122)
    h = draw(12, 26)
    wall = draw(3, 5)
    foot = draw(0.55, 0.7) * r
    return vessel(
        [(foot, 0), (foot + 0.45 * (r - foot), 0.55 * h), (r, h)], wall, min(wall, 0.35 * h)
    )


def vase(draw: Draw) -> Thing:
    """A vase with a belly and a narrower neck."""
    r = draw(25, 60)
    h = draw(80, 240)
    wall = draw(2, 6)
    neck = draw(0.4, 0.8)
    foot = draw(0.5, 0.9) * r
    outline = [
        (foot, 0),
        (r, draw(0.3, 0.5) * h),
        (neck * r, 0.8 * h),
        (draw(1.0, 1.4) * neck * r, h),
    ]
    return vessel(outline, wall, draw(4, 10))


def pot(draw: Draw) -> Thing:
    """A pot with two handles at its sides."""
    r = draw(45, 88)
    h = draw(45, 120)
    wall = draw(2, 5)
    half = draw(16, 28)
    start = math.sqrt(r**2 - half**2) - 0.6 * wall
    grip = move(
        turn(
            _grip(start, -half, half, r - start + draw(14, 28), draw(3, 5), draw(3.5, 6)), "x", 90
        ),
        z=0.8 * h,
    )
    sides = grip + turn(grip, "z", 180)
    return vessel([(0.92 * r, 0), (r, 0.15 * h), (r, h)], wall, draw(3, 7)) + sides


def pan(draw: Draw) -> Thing:
    """A shallow pan with a long handle."""
    r = draw(38, 70)
    h = draw(22, 45)
    wall = draw(2, 5)
    length = draw(70, 105)
    foot = draw(0.7, 0.95) * r
    start = 0.25 * foot + 0.75 * r - 0.6 * wall
    line = np.array([(start, 0, 0.75 * h), (r + 20, 0, 0.85 * h), (r + length, 0, h)])
    return vessel([(foot, 0), (r, h)], wall, draw(3, 6)) + path(line, draw(3.5, 7), draw(6, 12))


def pitcher(draw: Draw) -> Thing:
    """A tall jug with a spout and a handle, hollow."""
    r = draw(32, 55)
    h = draw(90, 200)
    wall = draw(3, 6)
    top = draw(0.7, 1.0) * r
    neck = draw(0.5, 0.65)
    lip = lump(
        np.array(
            [(-top + wall, y, z) for y in (-14, 14) for z in (0.86 * h, h)] + [(-top - 16, 0, h)]
        )
    )
    grip = _grip(
        top - 0.6 * wall, (neck + 0.05) * h, 0.92 * h, draw(25, 40), draw(3.5, 6), draw(5, 9)
    )
    return (
        vessel([(0.85 * r, 0), (r, 0.3 * h), (top, neck * h), (top, h)], wall, draw(4, 8))
        + lip
        + grip
    )


def bucket(draw: Draw) -> Thing:
    """A bucket or a basket with a bail over its mouth."""
    r = draw(28, 75)
    h = draw(40, 110)
    wall = draw(2, 5)
    rise = draw(0.7, 1.3)
    bail = path(arc((r - wall / 2, rise * r), 0, 180, 13, (0, 0, h - 6)), draw(3, 4.5), draw(3, 6))
    return vessel([(draw(0.65, 0.95) * r, 0), (r, h)], wall, draw(3, 7)) + bail


def teapot(draw: Draw) -> Thing:
    """A full pot with a lid, a spout, and a handle at its side or over it."""
    r = draw(32, 60)
    squat = draw(0.75, 1.1)
    h = squat * r
    body = move(stack(_round(r, h)), z=0.92 * h)
    knob = rod((0, 0, 1.8 * h), (0, 0, 1.9 * h + 6), 4) + pebble(9, 9, 7, (0, 0, 1.9 * h + 10))
    spout = rod(
        (-0.75 * r, 0, 0.8 * h), (-1.45 * r, 0, draw(1.3, 1.8) * h), draw(8, 12), draw(5, 7)
    )
    if draw(0, 1) < 0.5:
        return (
            body
            + knob
            + spout
            + path(arc((0.72 * r, 1.35 * h), -8, 188, 13, (0, 0, 1.6 * h)), 4, draw(4, 9))
        )
    return (
        body
        + knob
        + spout
        + _grip(0.85 * r, 0.55 * h, 1.3 * h, draw(25, 40), draw(4, 5.5), draw(5, 8))
    )


def funnel(draw: Draw) -> Thing:
    """A funnel that stands on its rim."""
    r = draw(25, 65)
    h = draw(30, 70)
    neck = draw(6, 12)
    tip = draw(25, 60)
    wall = draw(1.5, 3.5)
    hole = neck - min(wall, 0.5 * neck)
    slant = wall * math.hypot(1.0, (r - neck) / h)
    return shell([(r, r - slant, 0), (neck, hole, h), (0.8 * neck, 0.8 * hole, h + tip)])


def lamp(draw: Draw) -> Thing:
    """A table lamp: a foot, a stem and a shade."""
    foot = draw(25, 50)
    h = draw(110, 170)
    shade = draw(35, 70)
    low = draw(0.8, 1.2) * shade / 2 + 15
    high = draw(0.5, 0.9) * shade / 2 + 8
    stem = draw(4, 8)
    return stack([(foot, 0), (foot, 8), (stem, 16), (stem, h), (low, h), (high, h + shade)])


def tray(draw: Draw) -> Thing:
    """A rectangular tray or bin that is open above."""
    x = draw(50, 240)
    y = draw(45, 150)
    h = draw(12, 110)
    wall = draw(1.5, 6)
    return crate(x, y, h, wall, draw(2, 6))


def ladle(draw: Draw) -> Thing:
    """A ladle or a measuring cup: a small bowl with a long handle."""
    r = draw(20, 40)
    h = draw(15, 38)
    wall = draw(1.5, 3.5)
    length = draw(60, 160)
    line = np.array(
        [
            (0.976 * r - 0.6 * wall, 0, 0.85 * h),
            (r + 12, 0, 0.95 * h),
            (r + length, 0, h * draw(0.9, 2.0)),
        ]
    )
    return vessel([(0.6 * r, 0), (0.92 * r, 0.5 * h), (r, h)], wall, 3) + path(
        line, draw(2.5, 4), draw(4, 8)
    )


def _grip(x: float, low: float, high: float, reach: float, thick: float, wide: float) -> Thing:
    """Return a handle that leaves a wall at x horizontally at two heights, and reaches this far
    from it.
    """
    line = arc(1.0, 90, -90, 9, (0, 0, 0))
    middle = (low + high) / 2
    half = (high - low) / 2
    bent = np.sign(line) * np.abs(line) ** 0.7  # between an ellipse and a rectangle
    return path(bent * (reach, 1, half) + (x, 0, middle), thick, wide)


def _round(r: float, h: float) -> Profile:
    """Return the profile of a squat, round pot about the origin."""
    angle = np.linspace(math.pi - 0.4, 0.4, 9)
    return list(zip((r * np.sin(angle) ** 0.8).tolist(), (h * np.cos(angle)).tolist(), strict=True))


VESSELS = (
    can,
    bottle,
    flask,
    jar,
    tub,
    turned,
    ellipsoid,
    fruit,
    banana,
    mushroom,
    bulb,
    spool,
    dumbbell,
    pin,
    lid,
    ring,
    roll,
    cup,
    mug,
    goblet,
    bowl,
    dish,
    vase,
    pot,
    pan,
    pitcher,
    bucket,
    teapot,
    funnel,
    lamp,
    tray,
    ladle,
)
"""Families of this file. New ones come last."""
