"""From depth images to point clouds."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchgrasp.base import check_tensor
from torchgrasp.cloud.check import check_cloud
from torchgrasp.errors import BadArgument, TooFewPoints
from torchgrasp.frames import apply
from torchgrasp.values import PointCloud


def cloud_from_depth(
    depth: Float[Tensor, "h w"],
    intrinsics: Float[Tensor, "3 3"],
    mask: Bool[Tensor, "h w"] | None = None,
    camera_pose: Float[Tensor, "4 4"] | None = None,
) -> PointCloud:
    """Return the points of a pinhole camera's depth image.

    A pixel (row v, column u) of depth z is the point z ((u - cx) / fx, (v - cy) / fy, 1). The camera's frame has x
    right, y down and z forward. Depths of 0, NaN or infinity are not measured. The camera is the viewpoint.

    Args:
        depth: distance along the optical axis [m]; integer images in mm need `depth.double() / 1000`.
        intrinsics: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] [pixels].
        mask: pixels of the object; None: all measured pixels.
        camera_pose: obj_from_camera, rigid; None: the result is in the camera's frame.

    Raises:
        BadArgument: a wrong shape or type; negative depth; intrinsics of no pinhole camera; a pose that is not rigid.
        TooFewPoints: fewer than 4 measured pixels.
        SuspiciousScale: an extent outside [5 mm, 2 m]: depth in mm, or a scene without a mask.

    >>> K = torch.tensor([[600.0, 0, 32], [0, 600.0, 24], [0, 0, 1]])
    >>> cloud_from_depth(torch.full((48, 64), 0.5), K).viewpoint
    tensor([0., 0., 0.])
    """
    if not isinstance(depth, Tensor) or depth.ndim != 2 or depth.dtype not in (torch.float32, torch.float64):
        raise BadArgument("depth", _describe(depth), "a torch tensor (h, w), floating, in metres")
    if bool((depth < 0).any()):
        raise BadArgument("depth", f"{float(depth[depth < 0].min()):.4g} m", "depths >= 0")
    k = check_tensor("intrinsics", intrinsics, (3, 3)).to(depth)
    if not (k[0, 0] > 0 and k[1, 1] > 0) or k[0, 1] != 0 or k[1, 0] != 0 or k[2].tolist() != [0, 0, 1]:
        raise BadArgument("intrinsics", k.tolist(), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0")
    measured = torch.isfinite(depth) & (depth > 0)
    if mask is not None:
        if not isinstance(mask, Tensor) or mask.shape != depth.shape or mask.dtype != torch.bool:
            raise BadArgument("mask", _describe(mask), f"a torch tensor of bool {tuple(depth.shape)}")
        measured = measured & mask
    if int(measured.sum()) < 4:
        raise TooFewPoints("depth", f"{int(measured.sum())} measured pixels", "at least 4 measured pixels in the mask")
    row, column = torch.nonzero(measured, as_tuple=True)
    z = depth[measured]
    points = torch.stack([z * (column - k[0, 2]) / k[0, 0], z * (row - k[1, 2]) / k[1, 1], z], -1)
    viewpoint = torch.zeros(3, dtype=points.dtype, device=points.device)
    if camera_pose is not None:
        pose = check_rigid("camera_pose", camera_pose).to(points)
        points, viewpoint = apply(pose, points), pose[:3, 3]
    return check_cloud(PointCloud(points, None, viewpoint))


def _describe(value: object) -> str:
    """Return the type of an image, its shape and its dtype."""
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", "no dtype")
    return f"{type(value).__name__} of shape {tuple(shape)}, {dtype}"


def check_rigid(name: str, pose: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
    """Return a transform that is rigid to 1e-4; refuse others."""
    check_tensor(name, pose, (4, 4))
    rotation, eye = pose[:3, :3].double(), torch.eye(3, dtype=torch.float64, device=pose.device)
    error = float((rotation @ rotation.T - eye).abs().max())
    if error > 1e-4 or float(torch.linalg.det(rotation)) < 0 or pose[3].tolist() != [0, 0, 0, 1]:
        raise BadArgument(name, pose.tolist(), "a rigid transform: a right-handed rotation, and the row 0 0 0 1")
    return pose
