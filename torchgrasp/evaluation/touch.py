"""Whether the fingertips of a grasp touch the object at the planned posture, before any force."""

import dataclasses
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.cloud.neighbours import usual_spacing
from torchgrasp.cloud.prepare import estimate_normals
from torchgrasp.foundation.base import Value
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, MeshError, SuspiciousScale
from torchgrasp.foundation.lazy import spatial, trimesh
from torchgrasp.foundation.limits import MAX_EXTENT
from torchgrasp.foundation.rules import ANY, SmallLength
from torchgrasp.geometry.frames import apply
from torchgrasp.geometry.linalg import Points, dot, norm
from torchgrasp.geometry.mesh_distance import surface_distance
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import check_named
from torchgrasp.values.planning import Grasps, PointCloud

Verdict = Literal["touches", "apart", "penetrates", "unseen"]
"""Whether the fingertips of a grasp touch; the limit is by default 3 mm (`TOUCH.limit`).

* touches: each fingertip is within the limit of the surface.
* apart: a fingertip is farther off the surface than the limit.
* penetrates: none is apart, but a fingertip is deeper in the object than the limit.
* unseen: the cloud does not show the surface at a fingertip; all others touch.
"""


@dataclasses.dataclass(frozen=True)
class TouchNumbers:
    """Parameters of the verdict on touching fingertips."""

    limit: float = 0.003
    """Greatest gap [m] at which a fingertip counts as touching: the usual deviation of an estimated
    surface.
    """
    farthest: float = 0.5
    """Least distance [m] of all fingertips from the object at which it is in another frame."""
    reach: float = 1.5
    """Greatest distance of a fingertip from the cloud's nearest point, along the surface, in
    multiples of the points' spacing. Farther away, the cloud does not show the surface.
    """


TOUCH = TouchNumbers()


@checked
@dataclasses.dataclass(frozen=True)
class Touch(Value):
    """The gaps between the f fingertips of g grasps and the object; `measure_touch` returns it.

    Attributes:
        gaps: signed distances (g, f) [m] of the fingertips from the surface, at the planned
            postures. They are negative where a fingertip penetrates the object, and NaN where a
            cloud does not show the surface.
        limit: largest size [m] of a gap of either sign at which a fingertip counts as touching, 0
            to 0.1.
    """

    gaps: Annotated[Float[Tensor, "g f"], ANY]
    limit: SmallLength = TOUCH.limit

    @property
    def largest(self) -> Float[Tensor, "g"]:
        """The largest of the f gaps of each grasp (g,) [m]; NaN if none of them is known.

        A gap is the signed distance of a fingertip from the object's surface at the planned
        posture. It is negative if the fingertip penetrates the object.
        """
        return _known(self.gaps.nan_to_num(-torch.inf).amax(-1))

    @property
    def deepest(self) -> Float[Tensor, "g"]:
        """The smallest of the f gaps of each grasp (g,) [m]; NaN if none of them is known.

        A gap is the signed distance of a fingertip from the object's surface at the planned
        posture. It is negative if the fingertip penetrates the object.
        """
        return _known(self.gaps.nan_to_num(torch.inf).amin(-1))

    @property
    def verdicts(self) -> list[Verdict]:
        """The verdict on each of the g grasps at its planned posture, the first that applies.

        * "apart": a fingertip is farther than `limit` from the surface.
        * "penetrates": a fingertip is deeper in the object than `limit`.
        * "unseen": the cloud does not show the surface at a fingertip.
        * "touches": each fingertip is within `limit` of the surface.
        """
        verdicts = list[Verdict]()
        for gaps in self.gaps:
            verdict: Verdict = "touches"
            if (gaps > self.limit).any():
                verdict = "apart"
            elif (gaps < -self.limit).any():
                verdict = "penetrates"
            elif gaps.isnan().any():
                verdict = "unseen"
            verdicts.append(verdict)
        return verdicts


def _known(extremes: Float[Tensor, "g"]) -> Float[Tensor, "g"]:
    """Return the extremes of gaps [m], NaN where no gap was known."""
    return torch.where(extremes.isinf(), torch.nan, extremes)


@checked
def measure_touch(
    hand: Hand,
    grasps: Grasps,
    surface: "trimesh.Trimesh | PointCloud",
    limit: SmallLength = TOUCH.limit,
) -> Touch:
    """Return the gaps between fingertips and an object at the planned posture of each grasp.

    A gap is the signed distance from the object's surface to the sphere of a fingertip's pad. The
    pad is the part that touches objects. For a pad that is no sphere, the distance to its contact
    point counts. No forces are taken into account, and no errors of the hand's pose. The space
    behind the points of a cloud with a viewpoint counts as unseen.

    Args:
        hand: the hand of the grasps.
        grasps: g grasps; only `joints` and `obj_from_hand` are used.
        surface: the object's mesh [m] with faces turned outward, or its cloud [m]. Both are in the
            frame of the grasps, that of the planned cloud.
        limit: largest size [m] of a gap of either sign at which a fingertip counts as touching, 0
            to 0.1.

    Raises `BadArgument` for a hand or fingers that the grasps do not name, for joints beyond their
    limits, and for a cloud whose normals cannot be estimated. It is also raised for a surface more
    than 0.5 m (`TOUCH.farthest`) from all fingertips, which is in another frame. Raises `MeshError`
    for a closed mesh with faces turned inward, and `SuspiciousScale` for a mesh over 2 m.

    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "allegro")
    >>> measure_touch(load_hand("allegro"), grasp, jug.mesh, limit=0.01).verdicts
    ['touches']
    """
    check_named(hand, grasps)
    hand = hand.to("cpu", torch.float64)
    joints = hand.check_joints(grasps.joints.detach().double().cpu())
    centres = apply(grasps.obj_from_hand.detach().double().cpu(), hand.tip_centres(joints))
    points = centres.reshape(-1, 3)
    _check_frame(points, surface)
    if isinstance(surface, PointCloud):
        heights = _heights(points, surface, limit)
    else:
        _check_sides(surface)
        vertices = torch.tensor(surface.vertices, dtype=torch.float64)
        faces = torch.tensor(np.ascontiguousarray(surface.faces))
        distance = surface_distance(vertices, faces)
        heights = torch.from_numpy(distance(points.numpy()))
    return Touch(heights.reshape(centres.shape[:-1]) - hand.tip_radius, limit)


def _check_frame(points: Points, surface: "trimesh.Trimesh | PointCloud") -> None:
    """Raise `BadArgument` if all points are far from the box around a surface."""
    if isinstance(surface, PointCloud):
        corners = surface.points.detach().double().cpu()
    else:
        corners = torch.tensor(np.asarray(surface.vertices), dtype=torch.float64)
    if not len(points) or not len(corners):
        return
    beside = torch.maximum(corners.amin(0) - points, points - corners.amax(0)).clamp_min(0)
    away = float(norm(beside).amin())
    if away > TOUCH.farthest:
        found = f"one {away:.3g} m from all fingertips"
        raise BadArgument("surface", found, "the grasped object, in the frame of the grasps")


def _check_sides(mesh: "trimesh.Trimesh") -> None:
    """Raise an error for a mesh in millimetres, or a closed one that is turned inside out: every
    fingertip would penetrate it. An open mesh is taken.
    """
    longest = float(mesh.extents.max()) if len(mesh.faces) else 0.0
    if longest > MAX_EXTENT:
        allowed = f"at most {MAX_EXTENT:g} m: use metres"
        raise SuspiciousScale("surface", f"a mesh of {longest:.4g} m", allowed)
    if mesh.is_watertight and mesh.volume < 0:
        found = f"a mesh of volume {mesh.volume:.3g} m^3"
        raise MeshError("surface", found, "a positive volume, faces turned outward")


def _heights(points: Points, cloud: PointCloud, limit: float) -> Float[Tensor, "n"]:
    """Return the heights [m] of points above the surface of a cloud; NaN where it shows none."""
    cloud = cloud if cloud.normals is not None else estimate_normals(cloud)
    assert cloud.normals is not None
    seen = cloud.points.detach().double().cpu()
    normals = cloud.normals.detach().double().cpu()
    row = torch.from_numpy(spatial.KDTree(seen.numpy()).query(points.numpy())[1])
    away = points - seen[row]
    height = dot(away, normals[row])
    beside = norm(away - height[:, None] * normals[row])
    shown = beside <= TOUCH.reach * usual_spacing(seen)
    if cloud.viewpoint is not None:
        shown = shown & (height >= -limit)
    return torch.where(shown, height, torch.nan)
