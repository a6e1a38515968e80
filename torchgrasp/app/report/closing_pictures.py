"""Pictures of a hand and its object at moments of a simulated closing, all from one camera."""

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Int, UInt8
from torch import Tensor

from torchgrasp.app.report import canvas as paint
from torchgrasp.app.report.raster import Direction
from torchgrasp.app.report.solids import link_poses, place_solids
from torchgrasp.app.report.stills import add_solids
from torchgrasp.foundation.base import flatnonzero
from torchgrasp.foundation.lazy import trimesh
from torchgrasp.geometry.frames import apply, real, rotate, to_array
from torchgrasp.geometry.plane import Plane
from torchgrasp.hand.hand import Hand
from torchgrasp.values.closing import ClosureResult

FAR = 0.25  # an object this far from its first place [m] is lost, and is not framed


def finite_ticks(closure: ClosureResult) -> Int[Tensor, " k"]:
    """Return the indices (k,) of the recorded control ticks with finite poses and joints.

    A control tick is a period of the controller. Ticks with NaN or infinity come from a diverged
    simulation.
    """
    poses = closure.object_pose.isfinite() & closure.hand_pose.isfinite()
    return flatnonzero(closure.joints.isfinite().all(-1) & poses.all(-1).all(-1))


def draw_ticks(
    mesh: "trimesh.Trimesh",
    hand: Hand,
    closure: ClosureResult,
    ticks: Sequence[int],
    framed: Sequence[int],
    direction: Direction,
    table: Plane | None,
    size: tuple[int, int],
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yield pictures of the hand and the object at control ticks, the periods of the controller.

    Each picture holds red, green and blue of h x w pixels, 0 to 255. All have one camera.

    Args:
        mesh: the object's mesh [m], which `closure.object_pose` moves to a frame where z is up.
        hand: the hand of the closing.
        closure: the record of the closing, in that frame.
        ticks: indices in the record of the n control ticks that are drawn. Their poses and joints
            must be finite (`finite_ticks`).
        framed: indices from 0 to n - 1 of the drawn ticks at which the hand must be in view.
        direction: direction from the object to the camera, of any length.
        table: the level table, whose height becomes that of the object's lowest point at first;
            None means no table.
        size: width and height of a picture [pixels].
    """
    # each corner of each face has its own normal, which is computed once
    given = np.asarray(mesh.vertices)
    corners_of = np.asarray(mesh.faces)
    vertices = real(given[corners_of].reshape(-1, 3))
    normals = real(paint.sharp_normals(given, corners_of).reshape(-1, 3))
    faces = np.arange(len(vertices)).reshape(-1, 3)

    object_pose = closure.object_pose[ticks].double()
    places = to_array(apply(object_pose, vertices))  # (n, v, 3)
    bends = to_array(rotate(object_pose, normals))
    hand_pose = closure.hand_pose[ticks].double()
    poses = to_array(link_poses(hand, closure.joints[ticks], closure.joint_names, hand_pose))

    # one camera for all pictures: the lift is seen
    near = [x for x in places if np.abs(x - places[0]).mean(0).max() < FAR]
    hands = [solid.vertices for k in framed for solid in place_solids(hand, poses[k])]
    seen = np.concatenate([*near, *hands])
    camera = paint.frame_camera(seen, direction, size=size)
    if table is not None:
        start = apply(closure.object_pose[finite_ticks(closure)[0]].double(), vertices)
        table = dataclasses.replace(table, offset=float(start[:, 2].min()))
    for place, bend, pose in zip(places, bends, poses, strict=True):
        solids = place_solids(hand, pose)
        canvas = paint.Canvas()
        shadows = [(place, faces), *((s.vertices, s.faces) for s in solids)]
        canvas.add_table(seen, table, shadows)
        canvas.add_mesh(place, faces, paint.OBJECT, bend)
        add_solids(canvas, solids)
        yield canvas.render(camera, size)
