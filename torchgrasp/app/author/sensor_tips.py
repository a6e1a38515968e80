"""Sensor tips that a maker's file lacks: fingertips that reach farther, with a rounded end.

A sensor tip is a ball at the end of a cylinder of the same radius, added to the collision shapes of
the fingertip. The pad moves with it: its contact point by exactly the offset, its normal not.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from torchgrasp.app.author.fit_shapes import turned_shape
from torchgrasp.app.author.pads import Guess
from torchgrasp.app.author.visuals import Triangles
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.hand.hand_toml import LEAST_RADIUS, MOST_RADIUS, Pad
from torchgrasp.hand.urdf import LinkShape, Urdf


@dataclasses.dataclass(frozen=True)
class SensorNumbers:
    """Bounds of a sensor tip."""

    most_offset: float = 0.1  # farthest that a sensor reaches beyond the maker's tip [m]
    sides: int = 16  # sides of a sensor that is drawn


SENSOR = SensorNumbers()


def extend_pads(
    tips: Sequence[str],
    guess: Guess,
    offsets: Sequence[float],
    radii: Sequence[float],
    named: bool,
) -> tuple[Pad, ...]:
    """Return the pads of fingertips with sensor tips; a finger of offset 0 keeps its pad.

    `guess` holds the pads of the links `tips`, and the directions along which they are offset.
    `offsets` and `radii` [m] are those of `Wish`; `named` says whether the user gave the tips.
    Raises `BadArgument` for a wrong count or length, and for a flat tip without a radius.
    """
    if not offsets:
        if radii:
            raise BadArgument("tip_radius", list(radii), "--tip-offset beside it")
        return guess.pads
    for name, given in (("tip_offset", offsets), ("tip_radius", radii)):
        counts = {0, 1, len(tips)} if named else {0, 1}
        if len(given) not in counts:
            wanted = "one number, or with --tips one for each tip"
            raise BadArgument(name, f"{len(given)} numbers for {len(tips)} tips", wanted)
    for offset in offsets:
        if not 0.0 <= offset <= SENSOR.most_offset:
            wanted = f"lengths from 0 to {SENSOR.most_offset:g} m"
            raise BadArgument("tip_offset", f"{offset:g}", wanted)
    for radius in radii:
        if not LEAST_RADIUS <= radius <= MOST_RADIUS:
            wanted = f"radii from {LEAST_RADIUS:g} to {MOST_RADIUS:g} m"
            raise BadArgument("tip_radius", f"{radius:g}", wanted)
    every = offsets if len(offsets) > 1 else [*offsets] * len(tips)
    rounds = [pad.radius for pad in guess.pads]
    if radii:
        rounds = radii if len(radii) > 1 else [*radii] * len(tips)
    found = []
    for tip, pad, way, offset, radius in zip(
        tips, guess.pads, guess.outward, every, rounds, strict=True
    ):
        if not offset:
            found.append(pad)
            continue
        if not radius:
            raise BadArgument("tip_radius", f"none for {tip}, which is flat", "a radius [m]")
        contact = np.array(pad.contact) + offset * way
        found.append(_round_pad(contact, np.array(pad.normal), radius))
    return tuple(found)


def add_sensors(
    urdf: Urdf, tips: Sequence[str], guess: Guess, pads: Sequence[Pad]
) -> tuple[Urdf, list[str]]:
    """Return the URDF with a sensor tip for each pad that `extend_pads` moved, and a sentence.

    The sentence is the only one in a list, which is empty if no pad moved. Masses stay as they are.
    """
    shapes = dict[str, tuple[LinkShape, ...]]()
    told = []
    rows = zip(tips, guess.pads, guess.outward, pads, strict=True)
    for tip, before, way, pad in rows:
        if pad is before:
            continue
        offset = float((np.array(pad.contact) - before.contact) @ way)
        end = np.array(pad.center)
        # the third column of the turn is the axis of the cylinder
        turn = np.stack([*_across(way), way], 1)
        neck = turned_shape("cylinder", (pad.radius, offset), turn, end - offset / 2 * way)
        ball = turned_shape("sphere", (pad.radius,), np.eye(3), end)
        shapes[tip] = (neck, ball)
        x, y, z = (round(float(part), 3) + 0.0 for part in way)
        told.append(
            f"{tip} {1e3 * offset:g} mm along ({x:g}, {y:g}, {z:g}) in its frame, "
            f"radius {1e3 * pad.radius:g} mm"
        )
    links = tuple(
        dataclasses.replace(link, shapes=link.shapes + shapes.get(link.name, ()))
        for link in urdf.links
    )
    sentences = [f"sensor tips are added: {'; '.join(told)}"] if told else []
    return dataclasses.replace(urdf, links=links), sentences


def add_seen_sensors(
    seen: Mapping[str, Triangles], tips: Sequence[str], guess: Guess, pads: Sequence[Pad]
) -> dict[str, Triangles]:
    """Return the visual meshes by link [m], with a capsule for each pad that `extend_pads` moved.

    `seen` are the meshes without sensors, and `guess` holds the pads before they were moved. `pads`
    are those afterwards, in the order of the links `tips`.
    """
    shown = dict(seen)
    for tip, before, way, pad in zip(tips, guess.pads, guess.outward, pads, strict=True):
        if pad is before or tip not in shown:
            continue
        end = np.array(pad.center)
        offset = float((np.array(pad.contact) - before.contact) @ way)
        # of radius 1 first: trimesh leaves out triangles of less than 1e-8 square units
        sides = SENSOR.sides, SENSOR.sides
        capsule = trimesh.creation.capsule(offset / pad.radius, 1.0, count=sides)
        capsule.apply_scale(pad.radius)
        turn = np.eye(4)
        turn[:3, :3] = np.stack([*_across(way), way], 1)
        # its middle is halfway between the balls, wherever trimesh begins it
        middle = capsule.bounds.mean(0)[2]
        turn[:3, 3] = end - (offset / 2 + middle) * way
        capsule.apply_transform(turn)
        vertices, faces = shown[tip]
        both = np.concatenate([faces, np.asarray(capsule.faces) + len(vertices)])
        shown[tip] = np.concatenate([vertices, np.asarray(capsule.vertices)]), both
    return shown


def _round_pad(contact: np.ndarray, normal: np.ndarray, radius: float) -> Pad:
    """Return the pad of a ball that touches at a contact point with a normal."""
    cx, cy, cz = (float(part) for part in contact)
    nx, ny, nz = (float(part) for part in normal)
    x, y, z = (float(part) for part in contact - radius * normal)
    return Pad((cx, cy, cz), (nx, ny, nz), (x, y, z), radius)


def _across(way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two unit vectors that form a right-handed frame with a unit vector."""
    flat = np.eye(3)[int(np.abs(way).argmin())]
    one = np.cross(flat, way)
    one /= np.linalg.norm(one)
    return one, np.cross(way, one)
