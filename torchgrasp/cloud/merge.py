"""Several views of one object as one cloud."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.checks import checked
from torchgrasp.cloud.check import check_cloud
from torchgrasp.cloud.depth import check_rigid
from torchgrasp.cloud.prepare import estimate_normals
from torchgrasp.errors import BadArgument
from torchgrasp.geometry.frames import apply, rotate
from torchgrasp.geometry.linalg import unit_of_any
from torchgrasp.values import PointCloud


@checked
def merge_clouds(
    clouds: Sequence[PointCloud], poses: Sequence[Float[Tensor, "4 4"]] | Float[Tensor, "k 4 4"]
) -> PointCloud:
    """Return several views in one frame, with normals and the camera of each point.

    `estimate_normals` gives normals to a view without normals. A view with normals but without viewpoint leaves the
    result without viewpoint. Overlaps are twice as dense; `voxel_downsample` evens them.

    Args:
        clouds: points [m] of the views, each in its own frame.
        poses: obj_from_cloud of each view, rigid.

    Raises:
        BadArgument: no cloud; another number of poses; a pose that is not rigid; clouds of several dtypes or devices.
        TooFewPoints, SuspiciousScale: see `check_cloud`, for the views and for the result.

    >>> view = PointCloud(0.1 * torch.rand(90, 3), viewpoint=torch.tensor([0.0, 0.0, 1.0]))
    >>> len(merge_clouds([view, view], [torch.eye(4), torch.eye(4)]))
    180
    """
    if not len(clouds):
        raise BadArgument("clouds", "none", "at least one PointCloud")
    if len(poses) != len(clouds):
        raise BadArgument("poses", f"{len(poses)} for {len(clouds)} clouds", "one pose for each cloud")
    for i, (cloud, pose) in enumerate(zip(clouds, poses, strict=True)):
        check_cloud(cloud)
        check_rigid(f"poses[{i}]", pose)
    types = {(str(c.points.dtype), str(c.points.device)) for c in clouds}
    if len(types) > 1:
        raise BadArgument("clouds", f"points of {sorted(types)}", "one dtype on one device")
    views = [_view_in_frame(cloud, pose) for cloud, pose in zip(clouds, poses, strict=True)]
    if len(views) == 1:
        return views[0]
    normals = [v.normals for v in views if v.normals is not None]
    viewpoints = [v.viewpoint.expand(len(v), 3) for v in views if v.viewpoint is not None]
    viewpoint = torch.cat(viewpoints) if len(viewpoints) == len(views) else None
    frustums = [v.frustum.expand(len(v), 4, 3) for v in views if v.frustum is not None]
    frustum = torch.cat(frustums) if len(frustums) == len(views) else None
    return check_cloud(PointCloud(torch.cat([v.points for v in views]), torch.cat(normals), viewpoint, frustum))


def _view_in_frame(cloud: PointCloud, obj_from_cloud: Float[Tensor, "4 4"]) -> PointCloud:
    """Return a view with unit normals in the frame of the result."""
    cloud = estimate_normals(cloud) if cloud.normals is None else cloud
    assert cloud.normals is not None
    pose, dtype = obj_from_cloud.to(cloud.points).double(), cloud.points.dtype
    points, normals = apply(pose, cloud.points.double()), rotate(pose, unit_of_any(cloud.normals.double()))
    viewpoint, frustum = cloud.viewpoint, cloud.frustum
    if viewpoint is not None:
        viewpoint = apply(pose, viewpoint.double().reshape(-1, 3)).reshape(viewpoint.shape).to(dtype)
    if frustum is not None:
        frustum = rotate(pose, frustum.double().reshape(-1, 3)).reshape(frustum.shape).to(dtype)
    return PointCloud(points.to(dtype), normals.to(dtype), viewpoint, frustum)
