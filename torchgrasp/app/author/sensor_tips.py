"""Sensor tips that a maker's file lacks: fingertips that reach farther, with a rounded end.

A sensor tip is a ball at the end of a cylinder of the same radius. It is added to the collision
shapes of the fingertip. The pad moves with it: its contact point by exactly the offset, its normal
not.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

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
    """Numbers of a sensor tip, a rounded end that a tactile sensor adds to a fingertip."""

    # greatest distance [m] by which a sensor reaches beyond the maker's tip
    most_offset: float = 0.1
    sides: int = 16  # number of sides of the cylinder that is drawn for a sensor


SENSOR = SensorNumbers()


def extend_pads(
    tips: Sequence[str],
    guess: Guess,
    offsets: Sequence[float],
    radii: Sequence[float],
    named: bool,
) -> tuple[Pad, ...]:
    """Return the pads of fingertips that tactile sensors extend; a finger of offset 0 keeps its
    pad.

    `guess` holds the guessed pads of the links `tips`, and the directions along which they are
    offset. `offsets` [m] are the lengths by which sensors extend the tips; without any, no pad
    changes. `radii` [m] are those of the sensors' balls; without any, those of the guessed pads.
    Each has one number for all tips or, if the user `named` the tips, one for each.

    Raises `BadArgument` for a wrong count of numbers. Raises it also for a length outside 0 to 0.1
    m, or a radius outside 0.1 mm to 0.1 m. The same is raised for a flat pad without a radius, and
    for radii without offsets.
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


class Sensor(NamedTuple):
    """A sensor tip, a cylinder with a ball at its end that a sensor adds to a fingertip.

    `tip` names the fingertip's link. `pad` is its pad, moved to the ball. `way` (3,) is the unit
    vector along the cylinder, away from the maker's tip. Both are in the link's frame. `length` [m]
    is that of the cylinder.
    """

    tip: str
    pad: Pad
    way: np.ndarray
    length: float

    @property
    def turn(self) -> np.ndarray:
        """The axes (3, 3) of the cylinder as columns, in the link's frame; the third is `way`."""
        flat = np.eye(3)[int(np.abs(self.way).argmin())]
        one = np.cross(flat, self.way)
        one /= np.linalg.norm(one)
        return np.stack([one, np.cross(self.way, one), self.way], 1)


def find_sensors(tips: Sequence[str], guess: Guess, pads: Sequence[Pad]) -> list[Sensor]:
    """Return the sensor tips of a hand, one for each of the `pads` that `extend_pads` moved.

    A sensor tip is the end that a tactile sensor adds to a fingertip. `guess` holds the pads before
    they were moved, and `pads` those afterwards. Both are in the order of `tips`, the names of the
    fingertip links.
    """
    found = []
    for tip, before, way, pad in zip(tips, guess.pads, guess.outward, pads, strict=True):
        if pad is not before:
            length = float((np.array(pad.contact) - before.contact) @ way)
            found.append(Sensor(tip, pad, way, length))
    return found


def add_sensors(urdf: Urdf, sensors: Sequence[Sensor]) -> tuple[Urdf, list[str]]:
    """Return the URDF with the collision shapes of sensor tips added to the fingertips, and a
    sentence on them.

    The sentence is the only one in a list, which is empty without sensors. Masses stay as they are.
    """
    if not sensors:
        return urdf, []
    shapes = dict[str, tuple[LinkShape, ...]]()
    told = []
    for sensor in sensors:
        tip, pad, way, length = sensor
        end = np.array(pad.center)
        neck = turned_shape("cylinder", (pad.radius, length), sensor.turn, end - length / 2 * way)
        ball = turned_shape("sphere", (pad.radius,), np.eye(3), end)
        shapes[tip] = (neck, ball)
        x, y, z = (round(float(part), 3) + 0.0 for part in way)
        told.append(
            f"{tip} {1e3 * length:g} mm along ({x:g}, {y:g}, {z:g}) in its frame, "
            f"radius {1e3 * pad.radius:g} mm"
        )
    links = tuple(
        dataclasses.replace(link, shapes=link.shapes + shapes.get(link.name, ()))
        for link in urdf.links
    )
    return dataclasses.replace(urdf, links=links), [f"sensor tips are added: {'; '.join(told)}"]


def add_seen_sensors(
    seen: Mapping[str, Triangles], sensors: Sequence[Sensor]
) -> dict[str, Triangles]:
    """Return the visual meshes of links, each with a capsule for its sensor tip.

    `seen` holds the meshes without sensors by link: corners (v, 3) [m] in the link's frame, and
    faces (t, 3). A link without a mesh there gets no capsule.
    """
    shown = dict(seen)
    for sensor in sensors:
        tip, pad, way, length = sensor
        if tip not in shown:
            continue
        # of radius 1 first: trimesh leaves out triangles of less than 1e-8 square units
        sides = SENSOR.sides, SENSOR.sides
        capsule = trimesh.creation.capsule(length / pad.radius, 1.0, count=sides)
        capsule.apply_scale(pad.radius)
        pose = np.eye(4)
        pose[:3, :3] = sensor.turn
        # its middle is halfway between the balls, wherever trimesh begins it
        middle = capsule.bounds.mean(0)[2]
        pose[:3, 3] = np.array(pad.center) - (length / 2 + middle) * way
        capsule.apply_transform(pose)
        vertices, faces = shown[tip]
        shown[tip] = trimesh.util.append_faces([vertices, capsule.vertices], [faces, capsule.faces])
    return shown


def _round_pad(contact: np.ndarray, normal: np.ndarray, radius: float) -> Pad:
    """Return the pad of a ball that touches at a contact point with a normal."""
    cx, cy, cz = (float(part) for part in contact)
    nx, ny, nz = (float(part) for part in normal)
    x, y, z = (float(part) for part in contact - radius * normal)
    return Pad((cx, cy, cz), (nx, ny, nz), (x, y, z), radius)
