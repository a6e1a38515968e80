"""Rendered homes: a cabinet before a wall and beside a bed, slats, a bowed seat and a low stool. The
true plane is that of the mesh.
"""

import functools
import math
from typing import NamedTuple

import pytest
import torch
import trimesh
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from tests.make import box, load_hand
from torchgrasp import Scene
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.foundation.errors import NoSupport
from torchgrasp.planner.changes import list_changes
from torchgrasp.planner.request import Request
from torchgrasp.scene.scene import LOCAL

BALL = (-0.1, -0.06)
RADIUS = 0.8  # of the bowed seat [m]


class Home(NamedTuple):
    """A depth image [m], its intrinsics, the pixels of the ball, and the camera's pose."""

    depth: Float[Tensor, "h w"]
    intrinsics: Float[Tensor, "3 3"]
    ball: Bool[Tensor, "h w"]
    pose: Float[Tensor, "4 4"]

    def see(self, posed: bool = False, masked: bool = False) -> Scene:
        return Scene.from_depth(
            self.depth,
            self.intrinsics,
            self.pose if posed else None,
            mask=self.ball if masked else None,
        )

    def error(self, scene: Scene, normal=(0.0, 0.0, 1.0), place=(0.0, 0.0, 0.0)):
        """The angle [deg] of the table to a normal, and its height [mm] over a place in the room."""
        from_room = torch.eye(4).double()
        if bool((scene.image.obj_from_camera == torch.eye(4)).all()):
            from_room = torch.linalg.inv(self.pose.double())
        true = from_room[:3, :3] @ torch.tensor(normal).double()
        at = from_room[:3, :3] @ torch.tensor(place).double() + from_room[:3, 3]
        angle = math.acos(min(1.0, float(scene.table.normal.double() @ true)))
        return math.degrees(angle), 1e3 * abs(float(scene.table.height(at)))


def ball(height: float = 0.0) -> trimesh.Trimesh:
    """A ball that stands at a height."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.033)
    return mesh.apply_translation((*BALL, height + 0.033))


def wall(askew: float) -> trimesh.Trimesh:
    mesh = trimesh.creation.box((3.0, 0.02, 2.4))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(math.radians(askew), (0, 0, 1)))
    return mesh.apply_translation((0.0, 0.21, 0.6))


def others() -> list[trimesh.Trimesh]:
    """Things beside the ball."""
    return [box((0.05, 0.04, 0.05), (0.08, -0.09)), box((0.06, 0.05, 0.09), (-0.11, 0.09))]


def cabinet() -> list[trimesh.Trimesh]:
    top = trimesh.creation.box((0.4, 0.36, 0.5)).apply_translation((0.0, 0.0, -0.25))
    return [top, wall(8.0), box((3.0, 3.0, 0.02), (0.0, -0.5, -0.52))]


def bed() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    return mesh.apply_scale((0.35, 0.6, 0.25)).apply_translation((0.55, -0.15, -0.05))


def slats() -> list[trimesh.Trimesh]:
    rods = [box((0.6, 0.03, 0.015), (0.0, -0.2 + 0.045 * k, -0.0075)) for k in range(9)]
    behind = trimesh.creation.box((1.2, 0.02, 1.6)).apply_translation((0.0, 0.35, 0.1))
    return [*rods, behind, box((0.6, 0.45, 0.015), (0.0, 0.0, -0.25))]


def seat() -> list[trimesh.Trimesh]:
    mesh = trimesh.creation.box((0.42, 0.42, 0.02)).subdivide_to_size(0.03)
    places = mesh.vertices.copy()
    places[:, 2] += -0.01 + (places[:, 0] ** 2 + places[:, 1] ** 2) / (2 * RADIUS)
    mesh.vertices = places
    back = trimesh.creation.box((0.42, 0.02, 0.5)).apply_translation((0.0, 0.22, 0.28))
    return [mesh, back, box((3.0, 3.0, 0.02), (0.0, 0.0, -0.46))]


def stool() -> list[trimesh.Trimesh]:
    """A low stool under the ball, beside a large table with things on it."""
    table = box((0.9, 0.8, 0.03), (0.55, 0.1, 0.2))
    things = [box((0.06, 0.05, 0.08), (x, 0.0, 0.255)) for x in (0.2, 0.35, 0.5)]
    top = box((0.24, 0.24, 0.02), (BALL[0] - 0.1, BALL[1], -0.01))
    return [top, table, *things, box((3.0, 3.0, 0.02), (0.0, 0.0, -0.46))]


ROOMS = {
    "cabinet": (lambda: [*cabinet(), *others()], (-100.0, 40.0, 0.78)),
    "bed": (lambda: [*cabinet(), bed(), *others()], (-100.0, 40.0, 0.78)),
    "slats": (lambda: [*slats(), *others()], (-90.0, 30.0, 0.65)),
    "seat": (seat, (-90.0, 45.0, 0.75)),
    "stool": (stool, (-90.0, 45.0, 0.9)),
    "lone": (cabinet, (-100.0, 40.0, 0.78)),
}


@functools.cache
def home(kind: str) -> Home:
    """One home at half resolution, seen by a RealSense."""
    furniture, view = ROOMS[kind]
    height = (BALL[0] ** 2 + BALL[1] ** 2) / (2 * RADIUS) if kind == "seat" else 0.0
    pose = look_at(*view, torch.tensor([0.0, 0.03, 0.0]))
    meshes = [ball(height), *furniture()]
    depth, label = render_depth(meshes, pose, table=None, noise="realsense", seed=0)
    intrinsics = INTRINSICS.clone()
    intrinsics[:2] /= 2
    near = depth[::2, ::2].float()
    return Home(near, intrinsics, (label[::2, ::2] == 1) & (near > 0), pose)


@pytest.mark.parametrize("kind", ["cabinet", "bed", "slats", "lone"])
def test_the_table_is_found_before_walls_floors_and_beds(kind):
    seen = home(kind)
    for scene in (seen.see(), seen.see(posed=True, masked=True)):
        degrees, mm = seen.error(scene)
        assert degrees < 1 and mm < 5
    # with a pose no wall is offered
    assert all(float(plane.normal[2]) > 0.5 for plane in scene.supports)


@pytest.mark.parametrize("kind", ["cabinet", "bed", "lone"])
def test_a_good_mask_is_kept(kind):
    seen = home(kind)
    scene = seen.see(masked=True)
    kept = float((scene.pixel_labels == 1)[seen.ball].double().mean())
    told = [note for note in scene.notes if note.startswith("mask")]
    assert kept > 0.9
    assert kept > 0.95 or told


def test_a_mask_beside_its_object_is_told_with_the_shift_that_fits():
    seen = home("lone")
    for right, down in ((-6, 0), (5, -4)):
        moved = seen.ball.roll((down, right), (0, 1))
        notes = Scene.from_depth(seen.depth, seen.intrinsics, mask=moved).notes
        (note,) = [note for note in notes if "fits its object" in note]
        words = [f"{abs(right)} pixels {'right' if right < 0 else 'left'}"]
        words += [f"{abs(down)} pixels {'down' if down < 0 else 'up'}"] if down else []
        assert note.startswith(f"mask: it fits its object {' and '.join(words)}: align it")


def test_a_mask_that_is_too_wide_is_not_told_to_lie_beside_its_object():
    seen = home("lone")
    wide = torch.from_numpy(ndimage.binary_dilation(seen.ball.numpy(), iterations=6))
    notes = Scene.from_depth(seen.depth, seen.intrinsics, mask=wide).notes
    assert any("lie on the support" in note for note in notes)
    assert not any("fits its object" in note for note in notes)


def test_thin_bars_under_a_mask_are_kept():
    bars = [box((0.012, 0.012, 0.22), (x, 0.0)) for x in (-0.07, -0.02, 0.03, 0.08)]
    easel = trimesh.util.concatenate([*bars, box((0.17, 0.02, 0.015), (0.0, -0.01, 0.05))])
    pose = look_at(-90.0, 35.0, 0.9, torch.tensor([0.0, 0.0, 0.08]))
    depth, label = render_depth([easel, box((0.08, 0.06, 0.05), (-0.2, 0.05))], pose, noise=False)
    intrinsics = INTRINSICS.clone()
    intrinsics[:2] /= 3
    near = depth[::3, ::3].float()
    mask = (label[::3, ::3] == 1) & (near > 0)
    scene = Scene.from_depth(near, intrinsics, mask=mask)
    assert float((scene.pixel_labels == 1)[mask].double().mean()) > 0.95


def test_the_support_of_the_masked_thing_comes_before_a_larger_table():
    seen = home("stool")
    assert seen.error(seen.see())[1] > 100
    degrees, mm = seen.error(seen.see(masked=True), place=(*BALL, 0.0))
    assert degrees < 2 and mm < 5


def test_a_bowed_seat_is_refused_and_told_under_a_mask():
    seen = home("seat")
    with pytest.raises(NoSupport):
        seen.see()
    scene = seen.see(masked=True)
    assert LOCAL in scene.notes
    # the tangent plane under the ball
    slope = torch.tensor([-BALL[0] / RADIUS, -BALL[1] / RADIUS, 1.0])
    height = (BALL[0] ** 2 + BALL[1] ** 2) / (2 * RADIUS)
    degrees, mm = seen.error(scene, tuple((slope / slope.norm()).tolist()), (*BALL, height))
    assert degrees < 4 and mm < 10


def test_the_neighbours_in_the_advice_are_those_that_are_there():
    words = {}
    for kind in ("lone", "cabinet"):
        request = Request(home(kind).see(masked=True), load_hand("barrett"))
        words[kind] = [change.words for change in list_changes(request)]
    assert any("no object (a wall, or furniture" in text for text in words["lone"])
    assert any("its neighbours (object" in text for text in words["cabinet"])


def tray() -> list[trimesh.Trimesh]:
    """A bin whose floor is 2 cm above the room's, with things in it."""
    sides = [box((0.01, 0.54, 0.1), (x, 0.0)) for x in (-0.21, 0.21)]
    sides += [box((0.42, 0.01, 0.1), (0.0, y)) for y in (-0.27, 0.27)]
    return [box((0.42, 0.54, 0.01), (0.0, 0.0, -0.005)), *sides, *others()]


@pytest.mark.parametrize("sensor", ["zivid", "realsense"])
@pytest.mark.parametrize("view", [(20.0, 60.0, 0.8), (140.0, 55.0, 0.7), (250.0, 65.0, 0.85)])
def test_the_floor_of_a_bin_is_found_a_little_above_the_floor_of_the_room(view, sensor):
    floor = box((3.0, 3.0, 0.02), (0.0, 0.0, -0.03))
    pose = look_at(*view, torch.tensor([0.03, 0.02, 0.0]))
    depth, _ = render_depth([*tray(), floor], pose, table=None, noise=sensor, seed=0)
    intrinsics = INTRINSICS.clone()
    intrinsics[:2] /= 2
    near = depth[::2, ::2].float()
    seen = Home(near, intrinsics, near > 0, pose)
    degrees, mm = seen.error(seen.see())
    assert degrees < 1 and mm < 3
