"""Tools of a household, with handles, blades and jaws. Lengths are in mm, and long tools lie.

Each function makes one body of its family. Its table draws the first sizes, `draw` the others.
"""

import math

import numpy as np

from train.solids import (
    Draw,
    Families,
    Thing,
    arc,
    around,
    box,
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
    turn,
    vessel,
)

IMPLEMENTS: Families = {}
"""The families of this file by name. New ones come last."""


@family(IMPLEMENTS, handle=(70, 140), blade=(50, 95), rise=(0, 25))
def spatula(draw: Draw, handle: float, blade: float, rise: float) -> Thing:
    """A handle with a broad, thin blade that may be cranked."""
    line = np.array([(-handle, 0, rise + 5), (-20, 0, rise + 5), (8, 0, 4)])
    grip = path(line, draw(3.5, 7), draw(6, 12))
    return grip + move(slab(blade, draw(35, 85), draw(2.5, 6), 8, 0.5), blade / 2)


@family(IMPLEMENTS, a=(18, 38), b=(12, 26), length=(70, 165))
def spoon(draw: Draw, a: float, b: float, length: float) -> Thing:
    """A filled spoon with a bent handle."""
    line = np.array(
        [(0.7 * a, 0, 8), (a + 15, 0, 12), (a + 0.6 * length, 0, draw(12, 24)), (a + length, 0, 10)]
    )
    bowl = move(pebble(a, b, draw(5, 9)), z=7)
    return bowl + path(line, draw(2.2, 4), [draw(3, 5), 3, draw(4, 8), draw(5, 9)])


@family(IMPLEMENTS, many=(2, 6), tine=(30, 65), length=(70, 150), wide=(5, 7))
def fork(draw: Draw, many: float, tine: float, length: float, wide: float) -> Thing:
    """A fork, a rake or a comb of two to five prongs on a handle."""
    count = int(many)
    gap = wide + draw(3, 9)
    sides = (np.arange(count) - (count - 1) / 2) * gap
    lines = [np.array([(-8, y, 5), (0.5 * tine, y, 6), (tine, y, 12)]) for y in sides.tolist()]
    prongs = join(path(line, 2.5, [0.5 * wide, 0.45 * wide, 0.3 * wide]) for line in lines)
    bridge = box(14, (count - 1) * gap + wide, 6, (-8, 0, 2))
    handle = path(np.array([(-10, 0, 5), (-length, 0, 9)]), draw(2.5, 5), draw(4, 9))
    return prongs + bridge + handle


@family(IMPLEMENTS, many=(6, 20), pitch=(7, 11), tooth=(18, 40), h=(6, 12))
def comb(draw: Draw, many: float, pitch: float, tooth: float, h: float) -> Thing:
    """A spine with many teeth."""
    count = int(many)
    places = [((k - (count - 1) / 2) * pitch, tooth / 2, 0) for k in range(count)]
    teeth = join(box(0.5 * pitch, tooth, h - 1, at) for at in places)
    return teeth + box(count * pitch + 6, draw(12, 26), h, (0, -5, 0))


@family(IMPLEMENTS, handle=(80, 125), blade=(60, 120), wide=(18, 40), h=(9, 18))
def knife(draw: Draw, handle: float, blade: float, wide: float, h: float) -> Thing:
    """A knife that lies on its side, with a handle and a pointed blade."""
    outline = [(-5, -wide / 2), (0.6 * blade, -0.45 * wide), (blade, 0.35 * wide)]
    outline += [(blade, 0.5 * wide), (-5, 0.5 * wide)]
    grip = move(slab(handle, draw(16, 28), h, 6, 0.25 * h), x=-handle / 2)
    return grip + move(prism(outline, draw(2, 4)), z=0.4 * h)


@family(IMPLEMENTS, handle=(60, 130), head=(30, 100), wide=(14, 60), thick=(8, 16))
def brush(draw: Draw, handle: float, head: float, wide: float, thick: float) -> Thing:
    """A brush: a handle, a head and a block of bristles."""
    bristles = move(slab(0.9 * head, 0.85 * wide, draw(12, 35) + thick, 3, 0.5), x=head / 2)
    back = move(slab(head, wide, thick, 5, 2), x=head / 2)
    return bristles + back + rod((5, 0, 5), (-handle, 0, 6), 5, draw(5, 9))


@family(IMPLEMENTS, wide=(20, 75), hair=(35, 60), handle=(90, 130), h=(10, 20))
def broad(draw: Draw, wide: float, hair: float, handle: float, h: float) -> Thing:
    """A paint brush: a flat head of bristles that tapers, a ferrule and a thin handle."""
    tip = [(hair, t * 0.48 * wide, z) for t in (-1, 1) for z in (0.35 * h, 0.65 * h)]
    root = [(0.0, t * 0.48 * wide, z) for t in (-1, 1) for z in (0.05 * h, 0.95 * h)]
    line = np.array([(-10, 0, h / 2), (-25, 0, h / 2), (-40, 0, h / 2), (-25 - handle, 0, h / 2)])
    bristles = lump(np.array(tip + root))
    ferrule = box(22, wide, h, (-10, 0, 0))
    return bristles + ferrule + path(line, [0.4 * h, 0.4 * h, 4, 5], [0.4 * wide, 8, 6, 8])


@family(IMPLEMENTS, length=(130, 220), r=(6, 13), head=(55, 110), face=(9, 24))
def hammer(draw: Draw, length: float, r: float, head: float, face: float) -> Thing:
    """A hammer or a mallet, lying."""
    if draw(0, 1) < 0.5:
        top = lie(stack([(face, -head / 2), (face, head / 2)]))
    else:
        claw = [(s * 0.4 * face, head / 2, z) for s in (-1, 1) for z in (-2, 2)]
        half = 0.7 * face
        claw += [(s * 0.7 * face, 0.2 * head, z) for s in (-1, 1) for z in (-half, half)]
        top = box(1.6 * face, head, 1.6 * face, (0, -0.2 * head, -0.8 * face))
        top = top + lump(np.array(claw))
    return top + rod((-0.5 * face, 0, 0), (length - face, 0, 0), 0.8 * r, r)


@family(IMPLEMENTS, length=(120, 190), r=(7, 11), head=(35, 70), edge=(1, 4))
def axe(draw: Draw, length: float, r: float, head: float, edge: float) -> Thing:
    """A small axe or a cleaver, lying."""
    blade = [(-18, 10, z) for z in (-12, 12)] + [(16, 10, z) for z in (-12, 12)]
    blade += [(x, 10 + head, z) for x in (-30, 28) for z in (-edge, edge)]
    top = lump(np.array(blade)) + box(34, 34, 26, (-1, 0, -13))
    return top + rod((-22, 0, 0), (length - 22, 0, 0), r, 0.9 * r)


@family(IMPLEMENTS, r=(9, 18), grip=(60, 110), shaft=(40, 130))
def screwdriver(draw: Draw, r: float, grip: float, shaft: float) -> Thing:
    """A screwdriver, a file or an awl, lying."""
    sides = 8 if draw(0, 1) < 0.5 else 24
    handle = [(0.8 * r, 0), (r, 8), (r, 0.6 * grip), (0.7 * r, 0.8 * grip), (0.85 * r, grip)]
    return lie(
        stack(handle, sides=sides)
        + stack([(draw(2.5, 5), grip - 5), (draw(2, 4), grip + shaft)], sides=12)
    )


@family(IMPLEMENTS, r=(10, 20), grip=(70, 140), neck=(8, 25), head=(15, 45))
def torch(draw: Draw, r: float, grip: float, neck: float, head: float) -> Thing:
    """A flashlight or a microphone: a grip and a wider head, lying."""
    wide = draw(1.2, 1.9) * r
    outline = [(0.9 * r, 0), (r, 3), (r, grip), (wide, grip + neck), (wide, grip + neck + head)]
    top = grip + neck + head
    round_end = [(0.8 * wide, top + 0.5 * wide), (0.4 * wide, top + 0.8 * wide)]
    return lie(stack(outline + (round_end if draw(0, 1) < 0.4 else [])))


@family(IMPLEMENTS, length=(90, 170), h=(6, 14), wide=(10, 22))
def wrench(draw: Draw, length: float, h: float, wide: float) -> Thing:
    """A spanner with an open jaw, and a ring or a jaw at its other end."""
    size = draw(0.75, 1.1) * wide
    jaw = path(arc(size + 2, 50, 310, 11, (0, 0, 0)), 0.45 * wide, h / 2, sides=4)
    line = arc(0.9 * size + 3, 0, 337.5, 16, (0, 0, 0))
    other = path(line, 0.4 * wide, 0.45 * h, closed=True, sides=4)
    start = -size - 2
    end = -size - length
    shank = box(length, wide, 0.8 * h, ((start + end) / 2, 0, -0.4 * h))
    tail = other if draw(0, 1) < 0.5 else turn(jaw, "y", 180)
    return lie(jaw) + move(lie(tail), x=end - 0.9 * size) + shank


@family(IMPLEMENTS, r=(11, 18), t=(3, 5), blade=(50, 110), arm=(25, 55), open_=(6, 14))
def scissors(draw: Draw, r: float, t: float, blade: float, arm: float, open_: float) -> Thing:
    """Scissors that are open a little: two rings, two crossed blades."""
    thing = rod((0, 0, 0), (0, 0, 2 * t + 2), draw(4, 6))
    for s in (-1, 1):
        loop = lie(
            path(arc((draw(1.0, 1.5) * r + t, r + t), 0, 337.5, 16, (0, 0, 0)), t, t, closed=True)
        )
        edge = [(0.7 * blade, -5), (blade, -1), (blade, 1)]
        leg = prism([(-arm, -4), (0, -7), *edge, (0, 7), (-arm, 4)], t + 1.5)
        half = move(loop, x=-arm - r - 2, y=s * 0.35 * r, z=t)
        slant = math.degrees(math.atan2(0.5 * r, arm + r))
        thing += turn(half + move(leg, z=0 if s > 0 else t), "z", -s * open_ - s * slant)
    return thing


@family(IMPLEMENTS, length=(80, 130), t=(4, 7), bow=(14, 28), jaw=(25, 55))
def pliers(draw: Draw, length: float, t: float, bow: float, jaw: float) -> Thing:
    """Pliers: two bowed grips that meet at a joint, and two jaws."""
    thing = stack([(draw(9, 14), -t - 1), (10, t + 1)])
    for s in (-1, 1):
        bent = [(-0.25 * length, 0, s * bow), (-0.6 * length, 0, s * 1.1 * bow)]
        thing += lie(path(np.array([(0, 0, 0), *bent, (-length, 0, s * bow)]), 0.9 * t, t))
        front = [(0.3 * jaw, s * 9), (jaw, s * 4), (jaw, s * 0.7), (0, s * 0.7)]
        thing += move(prism([(-6, 0), (-6, s * 9), *front], 2 * t - 1), z=-t + 0.5)
    return thing


@family(IMPLEMENTS, length=(60, 200), wide=(4, 12), gap=(6, 24), t=(2, 4))
def tongs(draw: Draw, length: float, wide: float, gap: float, t: float) -> Thing:
    """Tongs, tweezers or a clothes peg: two arms that meet at one end."""
    bend = arc((gap + 4, gap), 90, 270, 9, (0, 0, 0))
    upper = [(length, 0, 0.4 * gap + t), (0.6 * length, 0, gap)]
    lower = [(0.6 * length, 0, -gap), (length, 0, -0.4 * gap - t)]
    return lie(path(np.concatenate([upper, bend, lower]), t, wide, sides=4))


@family(IMPLEMENTS, length=(80, 170), wide=(20, 42), rise=(6, 20), t=(8, 16))
def stapler(draw: Draw, length: float, wide: float, rise: float, t: float) -> Thing:
    """A stapler or a hole punch: a base and a jaw that rises from its hinge."""
    jaw = turn(move(slab(0.95 * length, 0.85 * wide, 1.3 * t, 4, 2), x=0.475 * length), "y", -rise)
    hinge = box(0.18 * length, 0.8 * wide, 1.6 * t, (0.08 * length, 0, 1))
    return move(slab(length, wide, t, 5, 1.5), x=length / 2) + move(jaw, z=0.8 * t + 1) + hinge


@family(IMPLEMENTS, x=(90, 170), y=(45, 85), z=(14, 30), rise=(28, 45))
def iron(draw: Draw, x: float, y: float, z: float, rise: float) -> Thing:
    """A flat iron, a stamp or a trowel: a pointed sole with a handle over it."""
    outline = [(-x / 2, -y / 2), (0.05 * x, -y / 2), (0.35 * x, -0.25 * y), (x / 2, 0)]
    outline += [(0.35 * x, 0.25 * y), (0.05 * x, y / 2), (-x / 2, y / 2)]
    handle = path(arc((0.36 * x, rise), -6, 186, 9, (-0.06 * x, 0, z)), draw(5, 8), draw(6, 11))
    return prism(outline, z, draw(0.75, 1.0)) + handle


@family(IMPLEMENTS, x=(60, 170), y=(30, 80), z=(40, 110))
def trolley(draw: Draw, x: float, y: float, z: float) -> Thing:
    """A box or a lunch case with an arched grip on its top."""
    line = arc((draw(0.22, 0.4) * x, draw(22, 45)), -5, 185, 11, (0, 0, z))
    grip = path(line, draw(3, 6), draw(4, 10))
    return slab(x, y, z, 6, 3) + grip


@family(IMPLEMENTS, r=(18, 36), length=(90, 170), grip=(70, 110), lean=(60, 105))
def dryer(draw: Draw, r: float, length: float, grip: float, lean: float) -> Thing:
    """A hair dryer, a drill or a toy pistol: a barrel with a grip across, lying."""
    barrel = [(0.8 * r, 0), (r, 0.15 * length), (r, 0.5 * length), (draw(0.45, 0.9) * r, length)]
    a = math.radians(lean)
    at = (0.25 * length, 0.0, 0.0)
    end = (at[0] - (grip + r) * math.cos(a), -(grip + r) * math.sin(a), 0.0)
    return turn(stack(barrel), "y", 90) + rod(at, end, 0.5 * r, draw(0.45, 0.65) * r)


@family(IMPLEMENTS, r=(22, 48), h=(25, 55), wall=(2, 5), grip=(40, 90))
def bell(draw: Draw, r: float, h: float, wall: float, grip: float) -> Thing:
    """A hand bell, a stamp or a plunger: a grip on a wide, hollow foot."""
    mouth = turn(vessel([(0.4 * r, 0), (0.6 * r, 0.4 * h), (r, h)], wall, wall + 2), "x", 180)
    knob = draw(7, 14)
    outline = [(0.35 * knob + 3, h - 2), (0.6 * knob, h + 8)]
    outline += [(knob, h + 0.7 * grip), (0.7 * knob, h + grip)]
    return move(mouth, z=h) + stack(outline)


@family(IMPLEMENTS, r=(24, 65), h=(6.5, 12), handle=(60, 110))
def racket(draw: Draw, r: float, h: float, handle: float) -> Thing:
    """A paddle, a hand mirror or a magnifier: a filled or open round head on a handle."""
    if draw(0, 1) < 0.5:
        head = stack([(r, -h / 2), (r, h / 2)], draw(0.75, 1.0))
    else:
        line = arc((r - 4, (r - 4) * draw(0.75, 1.0)), 0, 345, 24, (0, 0, 0))
        head = lie(path(line, 4, h / 2, closed=True))
    return head + rod((r - 4, 0, 0), (r + handle, 0, 0), 0.42 * h + 1, draw(4, 10))


@family(IMPLEMENTS, r=(18, 34), tall=(35, 60), wire=(2, 3), grip=(70, 120), many=(2, 4))
def whisk(draw: Draw, r: float, tall: float, wire: float, grip: float, many: float) -> Thing:
    """A whisk or a cage: wire bows that cross on a handle, lying."""
    count = int(many)
    bows = around(path(arc((r, tall), -55, 235, 11, (0, 0, 0)), wire), count, 180)
    start = -tall * math.sin(math.radians(55))
    return lie(bows + stack([(0.5 * r, start - grip), (0.65 * r, start + 4)]))


@family(IMPLEMENTS, x=(60, 110), z=(40, 80), wire=(3, 6))
def hanger(draw: Draw, x: float, z: float, wire: float) -> Thing:
    """A triangular frame with a hook, lying: a hanger, a set square, a carabiner."""
    ends = [(-x, 0, 0), (x, 0, 0), (0, 0, z)]
    frame = join(
        rod(ends[k - 1], ends[k], wire) + pebble(1.3 * wire, 1.2 * wire, 1.3 * wire, ends[k])
        for k in range(3)
    )
    r = draw(10, 18)
    bow = path(arc(r, 190, -90, 10, (0, 0, z + 4 + r)), 0.7 * wire)
    return lie(frame + bow + rod((0, 0, z - 2), (0, 0, z + 6), wire))


@family(IMPLEMENTS, r=(14, 28), h=(6.5, 12), shaft=(40, 90))
def key(draw: Draw, r: float, h: float, shaft: float) -> Thing:
    """A large key, a valve or a tap: a ring or a disc, a shaft, teeth at its end."""
    loop = lie(path(arc((r, 0.85 * r), 0, 337.5, 16, (0, 0, 0)), 0.45 * h + 1, h / 2, closed=True))
    bits = [(at * shaft, draw(8, 22)) for at in (0.7, 0.92)]
    teeth = join(box(draw(5, 9), tall, 0.7 * h, (r + at, tall / 2, -0.35 * h)) for at, tall in bits)
    return loop + rod((r - 1, 0, 0), (r + shaft, 0, 0), 0.42 * h) + teeth


@family(IMPLEMENTS, r=(30, 52), h=(55, 100), wall=(2.5, 5), spout=(50, 80))
def watering(draw: Draw, r: float, h: float, wall: float, spout: float) -> Thing:
    """A watering can: a hollow drum with a long spout and a handle behind."""
    line = arc((draw(24, 36), 0.4 * h), -88, 88, 9, (r - 0.6 * wall, 0, 0.5 * h))
    handle = path(line, 4, draw(4, 8))
    end = (-r - spout, 0, draw(0.9, 1.3) * h)
    tube = rod((-r + 0.5 * wall + 3, 0, 0.2 * h), end, draw(7, 11), 6)
    return vessel([(r, 0), (r, h)], wall, 4) + handle + tube
