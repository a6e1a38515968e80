"""Round and hollow things of a household: solids of revolution, and vessels with thin walls.
Lengths are in mm.

Each function makes one body of its family. Its table draws the first sizes, `draw` the others.
"""

import math

import numpy as np

from train.solids import (
    Draw,
    Families,
    Profile,
    Thing,
    arc,
    ball,
    crate,
    family,
    lie,
    lump,
    move,
    path,
    pebble,
    rod,
    shell,
    stack,
    tip,
    turn,
    vessel,
)

VESSELS: Families = {}
"""The families of this file by name. New ones come last."""


@family(VESSELS, r=(22, 52), h=(35, 180), edge=(1, 5))
def can(draw: Draw, r: float, h: float, edge: float) -> Thing:
    """A tin with a rim that is cut or narrower."""
    return stack([(draw(0.85, 0.97) * r, 0), (r, edge), (r, h - edge), (draw(0.85, 0.97) * r, h)])


@family(VESSELS)
def bottle(draw: Draw) -> Thing:
    """A bottle with a shoulder, a neck and a cap, some with a waist."""
    return _bottle(draw, 1.0)


@family(VESSELS, oval=(0.45, 0.8))
def flask(draw: Draw, oval: float) -> Thing:
    """An oval bottle, as of shampoo."""
    return _bottle(draw, oval)


@family(VESSELS, r=(22, 48), h=(40, 150), neck=(0.7, 0.95))
def jar(draw: Draw, r: float, h: float, neck: float) -> Thing:
    """A filled jar with a lid."""
    lid = (0.7 + 0.3 * draw(0, 1)) * r
    body = stack(
        [(0.92 * r, 0), (r, 0.05 * h), (r, 0.7 * h), (neck * lid, 0.82 * h), (neck * lid, 0.86 * h)]
    )
    return body + move(stack([(lid, 0), (lid, 0.1 * h), (0.95 * lid, 0.14 * h)]), z=0.86 * h)


@family(VESSELS, r=(24, 65), h=(30, 115), lip=(1, 4))
def tub(draw: Draw, r: float, h: float, lip: float) -> Thing:
    """A filled tub that is wider at its rim than at its foot, as of yoghurt."""
    foot = draw(0.6, 0.9) * r
    oval = draw(0.7, 1.0) if draw(0, 1) < 0.3 else 1
    return stack([(foot, 0), (r, h - lip), (r + lip, h - lip), (r + lip, h)], oval)


@family(VESSELS, many=(4, 10), h=(30, 180), r=(12, 42))
def turned(draw: Draw, many: float, h: float, r: float) -> Thing:
    """A turned piece of any profile: a chess piece, a knob, a candlestick."""
    count = int(many)
    radii = [r * draw(0.3, 1.0) for _ in range(count)]
    radii[0] = r * draw(0.8, 1.1)
    return stack(list(zip(radii, np.linspace(0, h, count).tolist(), strict=True)), draw(0.7, 1.0))


@family(VESSELS, r=(11, 62), middle=(0.6, 1.0))
def ellipsoid(draw: Draw, r: float, middle: float) -> Thing:
    """A ball, or an egg or a pebble that lies on its shortest axis."""
    return ball(r, r, r) if draw(0, 1) < 0.35 else ball(r, r * middle, r * middle * draw(0.6, 1.0))


@family(VESSELS, r=(18, 48), tall=(0.8, 1.4), lean=(-0.4, 0.4), blunt=(0.6, 1.2))
def fruit(draw: Draw, r: float, tall: float, lean: float, blunt: float) -> Thing:
    """An apple, a pear, a lemon or a pepper, some with a stem; long ones lie."""
    angle = np.linspace(math.pi - 0.25, 0.25, 10)
    radii = r * np.sin(angle) ** blunt * (1 + lean * np.cos(angle))
    body = stack(list(zip(radii, tall * r * np.cos(angle), strict=True)))
    if draw(0, 1) < 0.5:
        body += rod((0, 0, 0.9 * tall * r), (4, 0, tall * r + draw(5, 15)), draw(2, 4))
    return turn(body, "x", 90 if tall > 1.15 else 0)


@family(VESSELS, r=(11, 20), spread=(35, 65))
def banana(draw: Draw, r: float, spread: float) -> Thing:
    """A bent, pointed fruit that lies on its side."""
    share = np.linspace(-1, 1, 12)
    radius = r * np.sqrt(1.08 - share**2)
    line = arc(draw(80, 110), 270 - spread, 270 + spread, 12, (0, 0, 0))
    return lie(path(line, radius))


@family(VESSELS, r=(16, 45), h=(25, 70))
def mushroom(draw: Draw, r: float, h: float) -> Thing:
    """A stem with a wide, domed cap."""
    stem = draw(0.25, 0.6) * r
    rise = draw(0.5, 0.9) * r
    cap = [(r * math.cos(t), h + rise * math.sin(t)) for t in np.linspace(0, 1.35, 6)]
    return stack([(1.1 * stem, 0), (stem, h), (0.9 * r, h), *[(x, z + 1) for x, z in cap]])


@family(VESSELS, r=(16, 42), neck=(0.35, 0.55), base=(20, 35))
def bulb(draw: Draw, r: float, neck: float, base: float) -> Thing:
    """A light bulb that lies."""
    angle = np.linspace(math.asin(neck), math.pi - 0.07, 8)
    glass = [(r * math.sin(t), base + 1.2 * r - r * math.cos(t)) for t in angle]
    return lie(stack([(0.6 * neck * r, 0), (neck * r, 4), (neck * r, base), *glass]))


@family(VESSELS, r=(14, 45), h=(20, 90), rim=(3, 8))
def spool(draw: Draw, r: float, h: float, rim: float) -> Thing:
    """A reel: two flanges and a core, standing or lying."""
    core = draw(0.35, 0.8) * r
    pieces = stack([(r, 0), (r, rim), (core, rim), (core, h - rim), (r, h - rim), (r, h)])
    return tip(draw, pieces, 0.5)


@family(VESSELS, r=(18, 45), end=(20, 55), grip=(50, 130))
def dumbbell(draw: Draw, r: float, end: float, grip: float) -> Thing:
    """Two heavy ends and a grip between them, lying."""
    sides = 6 if draw(0, 1) < 0.5 else 24
    core = draw(0.3, 0.6) * r
    outline = [(0.8 * r, 0), (r, 0.2 * end), (r, end), (core, end), (core, end + grip)]
    outline += [(r, end + grip), (r, 1.8 * end + grip), (0.8 * r, 2 * end + grip)]
    return lie(stack(outline, sides=sides))


@family(VESSELS, r=(9, 28), length=(60, 160), end=(15, 42))
def pin(draw: Draw, r: float, length: float, end: float) -> Thing:
    """A rolling pin, a bat or a pestle: a thick rod with thinner ends, lying."""
    first = draw(0.3, 0.7) * r
    last = draw(0.3, 1.0) * r
    thinner = (draw(0.6, 1.0) * r, end + length)
    outline = [(first, 0), (first, end), (r, end + 0.1 * length), thinner]
    return lie(stack([*outline, (last, end + length), (last, 2 * end + length)]))


@family(VESSELS, r=(25, 95), h=(5, 18), knob=(7, 16))
def lid(draw: Draw, r: float, h: float, knob: float) -> Thing:
    """A lid with a knob."""
    body = [(r, 0), (r, 3), (0.6 * r, h), (0.45 * knob, h), (0.45 * knob, h + 8)]
    return stack([*body, (knob, h + 12), (knob, h + 16), (0.7 * knob, h + 20)])


@family(VESSELS, wide=(16, 80), r=(4, 15))
def ring(draw: Draw, wide: float, r: float) -> Thing:
    """A round or oval ring that lies."""
    line = arc((wide + r, (wide + r) * draw(0.6, 1.0)), 0, 345, 24, (0, 0, 0))
    return lie(path(line, r, r * draw(0.7, 1.5), closed=True))


@family(VESSELS, r=(15, 60), h=(12, 120), hole=(0.35, 0.92))
def roll(draw: Draw, r: float, h: float, hole: float) -> Thing:
    """A roll of tape or paper, or a piece of pipe: open at both ends, standing or lying."""
    inner = min(hole * r, r - 1.5)
    return tip(draw, shell([(r, inner, 0), (r, inner, h)]), 0.3)


@family(VESSELS, r=(22, 48), h=(45, 150), wall=(1, 5))
def cup(draw: Draw, r: float, h: float, wall: float) -> Thing:
    """A beaker without a handle, upright or upside down."""
    outline = [(draw(0.6, 1.0) * r, 0), (draw(0.85, 1.0) * r, 0.5 * h), (r, h)]
    return tip(draw, vessel(outline, wall, draw(2, 8)), 0.2, 180)


@family(VESSELS, r=(28, 46), h=(60, 125), wall=(2.5, 5.5))
def mug(draw: Draw, r: float, h: float, wall: float) -> Thing:
    """A mug with a handle."""
    foot = draw(0.75, 1.0) * r
    pieces = vessel([(foot, 0), (r, 0.45 * h), (r, h)], wall, draw(3, 7))
    reach = draw(18, 38)
    low = h * draw(0.48, 0.55)
    high = h * draw(0.8, 0.9)
    return pieces + _grip(r - 0.6 * wall, low, high, reach, draw(3, 5), draw(4, 9))


@family(VESSELS, r=(24, 45), bowl=(45, 100), stem=(30, 95), wall=(1.5, 3))
def goblet(draw: Draw, r: float, bowl: float, stem: float, wall: float) -> Thing:
    """A glass on a stem."""
    foot = draw(0.75, 1.0) * r
    thin = draw(3.5, 7)
    up = vessel([(0.45 * r, 0), (r, 0.5 * bowl), (draw(0.75, 1.1) * r, bowl)], wall, 5)
    leg = stack([(foot, 0), (foot, 3), (thin, 9), (thin, stem - 6), (0.45 * r, stem)])
    return leg + move(up, z=stem)


@family(VESSELS, r=(38, 110), h=(28, 85), wall=(2, 6))
def bowl(draw: Draw, r: float, h: float, wall: float) -> Thing:
    """A bowl with a foot, upright or upside down, round or oval."""
    foot = draw(0.35, 0.65) * r
    belly = [(foot + 0.62 * (r - foot), 0.33 * h), (foot + 0.9 * (r - foot), 0.67 * h)]
    oval = draw(0.65, 1.0) if draw(0, 1) < 0.3 else 1.0
    pieces = vessel([(foot, 0), *belly, (r, h)], wall, min(1.5 * wall, 0.2 * h), oval)
    return tip(draw, pieces, 0.2, 180)


@family(VESSELS, r=(45, 122), h=(12, 26), wall=(3, 5))
def dish(draw: Draw, r: float, h: float, wall: float) -> Thing:
    """A plate or a saucer."""
    foot = draw(0.55, 0.7) * r
    outline = [(foot, 0), (foot + 0.45 * (r - foot), 0.55 * h), (r, h)]
    return vessel(outline, wall, min(wall, 0.35 * h))


@family(VESSELS, r=(25, 60), h=(80, 240), wall=(2, 6), neck=(0.4, 0.8))
def vase(draw: Draw, r: float, h: float, wall: float, neck: float) -> Thing:
    """A vase with a belly and a narrower neck."""
    foot = draw(0.5, 0.9) * r
    outline = [(foot, 0), (r, draw(0.3, 0.5) * h), (neck * r, 0.8 * h)]
    return vessel([*outline, (draw(1.0, 1.4) * neck * r, h)], wall, draw(4, 10))


@family(VESSELS, r=(45, 88), h=(45, 120), wall=(2, 5), half=(16, 28))
def pot(draw: Draw, r: float, h: float, wall: float, half: float) -> Thing:
    """A pot with two handles at its sides."""
    start = math.sqrt(r**2 - half**2) - 0.6 * wall
    bow = _grip(start, -half, half, r - start + draw(14, 28), draw(3, 5), draw(3.5, 6))
    grip = move(lie(bow), z=0.8 * h)
    sides = grip + turn(grip, "z", 180)
    return vessel([(0.92 * r, 0), (r, 0.15 * h), (r, h)], wall, draw(3, 7)) + sides


@family(VESSELS, r=(38, 70), h=(22, 45), wall=(2, 5), length=(70, 105))
def pan(draw: Draw, r: float, h: float, wall: float, length: float) -> Thing:
    """A shallow pan with a long handle."""
    foot = draw(0.7, 0.95) * r
    start = 0.25 * foot + 0.75 * r - 0.6 * wall
    line = np.array([(start, 0, 0.75 * h), (r + 20, 0, 0.85 * h), (r + length, 0, h)])
    return vessel([(foot, 0), (r, h)], wall, draw(3, 6)) + path(line, draw(3.5, 7), draw(6, 12))


@family(VESSELS, r=(32, 55), h=(90, 200), wall=(3, 6))
def pitcher(draw: Draw, r: float, h: float, wall: float) -> Thing:
    """A tall jug with a spout and a handle, hollow."""
    top = draw(0.7, 1.0) * r
    neck = draw(0.5, 0.65)
    rim = [(-top + wall, y, z) for y in (-14, 14) for z in (0.86 * h, h)]
    lip = lump(np.array([*rim, (-top - 16, 0, h)]))
    low = (neck + 0.05) * h
    grip = _grip(top - 0.6 * wall, low, 0.92 * h, draw(25, 40), draw(3.5, 6), draw(5, 9))
    outline = [(0.85 * r, 0), (r, 0.3 * h), (top, neck * h), (top, h)]
    return vessel(outline, wall, draw(4, 8)) + lip + grip


@family(VESSELS, r=(28, 75), h=(40, 110), wall=(2, 5), rise=(0.7, 1.3))
def bucket(draw: Draw, r: float, h: float, wall: float, rise: float) -> Thing:
    """A bucket or a basket with a bail over its mouth."""
    bail = path(arc((r - wall / 2, rise * r), 0, 180, 13, (0, 0, h - 6)), draw(3, 4.5), draw(3, 6))
    return vessel([(draw(0.65, 0.95) * r, 0), (r, h)], wall, draw(3, 7)) + bail


@family(VESSELS, r=(32, 60), squat=(0.75, 1.1))
def teapot(draw: Draw, r: float, squat: float) -> Thing:
    """A full pot with a lid, a spout, and a handle at its side or over it."""
    h = squat * r
    body = move(stack(_round(r, h)), z=0.92 * h)
    knob = rod((0, 0, 1.8 * h), (0, 0, 1.9 * h + 6), 4) + pebble(9, 9, 7, (0, 0, 1.9 * h + 10))
    end = (-1.45 * r, 0, draw(1.3, 1.8) * h)
    spout = rod((-0.75 * r, 0, 0.8 * h), end, draw(8, 12), draw(5, 7))
    if draw(0, 1) < 0.5:
        grip = path(arc((0.72 * r, 1.35 * h), -8, 188, 13, (0, 0, 1.6 * h)), 4, draw(4, 9))
    else:
        grip = _grip(0.85 * r, 0.55 * h, 1.3 * h, draw(25, 40), draw(4, 5.5), draw(5, 8))
    return body + knob + spout + grip


@family(VESSELS, r=(25, 65), h=(30, 70), neck=(6, 12), tip=(25, 60), wall=(1.5, 3.5))
def funnel(draw: Draw, r: float, h: float, neck: float, tip: float, wall: float) -> Thing:
    """A funnel that stands on its rim."""
    hole = neck - min(wall, 0.5 * neck)
    slant = wall * math.hypot(1.0, (r - neck) / h)
    return shell([(r, r - slant, 0), (neck, hole, h), (0.8 * neck, 0.8 * hole, h + tip)])


@family(VESSELS, foot=(25, 50), h=(110, 170), shade=(35, 70))
def lamp(draw: Draw, foot: float, h: float, shade: float) -> Thing:
    """A table lamp: a foot, a stem and a shade."""
    low = draw(0.8, 1.2) * shade / 2 + 15
    high = draw(0.5, 0.9) * shade / 2 + 8
    stem = draw(4, 8)
    return stack([(foot, 0), (foot, 8), (stem, 16), (stem, h), (low, h), (high, h + shade)])


@family(VESSELS, x=(50, 240), y=(45, 150), h=(12, 110), wall=(1.5, 6))
def tray(draw: Draw, x: float, y: float, h: float, wall: float) -> Thing:
    """A rectangular tray or bin that is open above."""
    return crate(x, y, h, wall, draw(2, 6))


@family(VESSELS, r=(20, 40), h=(15, 38), wall=(1.5, 3.5), length=(60, 160))
def ladle(draw: Draw, r: float, h: float, wall: float, length: float) -> Thing:
    """A ladle or a measuring cup: a small bowl with a long handle."""
    end = (r + length, 0, h * draw(0.9, 2.0))
    line = np.array([(0.976 * r - 0.6 * wall, 0, 0.85 * h), (r + 12, 0, 0.95 * h), end])
    cup = vessel([(0.6 * r, 0), (0.92 * r, 0.5 * h), (r, h)], wall, 3)
    return cup + path(line, draw(2.5, 4), draw(4, 8))


def _bottle(draw: Draw, oval: float) -> Thing:
    """Return a bottle of this oval section."""
    r = draw(20, 43)
    h = draw(100, 245)
    shoulder = draw(0.45, 0.7)
    neck = draw(0.28, 0.6)
    waist = draw(0.75, 0.95) if draw(0, 1) < 0.4 else 1.0
    top = shoulder + draw(0.08, 0.2)
    mouth = neck * r
    slope = ((0.6 + 0.4 * neck) * r, (0.4 * shoulder + 0.6 * top) * h)
    body = [(0.9 * r, 0), (r, 0.04 * h), (waist * r, 0.5 * shoulder * h), (r, shoulder * h)]
    glass = stack([*body, slope, (mouth, top * h), (mouth, 0.92 * h)], oval)
    # the union depends on which solid was made first
    cap = stack([(1.15 * neck * r, 0), (1.05 * neck * r, 0.1 * h)], oval)
    return glass + move(cap, z=0.9 * h)


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
