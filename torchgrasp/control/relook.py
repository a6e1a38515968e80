"""A second look at an object: how far it has moved along its table since its surface was estimated."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.checks import checked
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.linalg import across, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.values.planning import PointCloud

REACH = 0.08  # largest displacement [m] on each axis of the table that `relocate` tries at first
SCALE = 0.004  # distance [m] from the surface beyond which a point of a new view counts less


@checked
def relocate(surface: SignedDistanceField, cloud: PointCloud, table: Plane) -> Float[Tensor, "4 4"]:
    """Return the motion of an object along its table since its surface was estimated: old points to
    new points.

    The motion minimises the sum of log(1 + (d_i / s)^2), with the signed distances d_i of the new
    points from the moved surface and s = 4 mm (Cauchy's cost, which outliers hardly move). A grid
    search to 80 mm and 30 degrees starts Gauss-Newton steps. The `surface` (`surface_field`), a new
    `cloud` of the object [m] and the `table` are in one frame.
    """
    # points of the cloud, places of the grid, and steps from each of them
    most = 300
    best = 16
    steps = 20
    rows = torch.linspace(0, len(cloud) - 1, min(len(cloud), most)).round().long()
    search = _Registration(surface, cloud.points[rows], table)
    # [m, rad]
    line = torch.linspace(-REACH, REACH, 17).double()
    turns = torch.linspace(-0.52, 0.52, 7).double()
    motions = torch.cartesian_prod(line, line, turns)
    motions = motions[search.cost(surface.nearest_node(search.undo(motions))).argsort()[:best]]
    for _ in range(steps):
        motions = motions + search.step(motions)
    found = motions[search.cost(surface.query(search.undo(motions))[0]).argmin()]
    rotation = rotation_from_vector(found[2] * search.up)
    return rigid(rotation, search.pivot + found[:2] @ search.axes - rotation @ search.pivot)


class _Registration:
    """The costs of motions (m, 3) of an object, each a shift along two axes [m] and a turn about
    the vertical [rad].
    """

    def __init__(
        self, surface: SignedDistanceField, points: Float[Tensor, "n 3"], table: Plane
    ) -> None:
        self.surface = surface
        self.points = points.double().cpu()
        self.up = unit(table.normal.double())
        self.axes = torch.stack(across(self.up))
        inside = torch.nonzero(surface.values < 0).double().mean(0)
        self.pivot = surface.origin.double() + surface.spacing * inside

    def undo(self, motions: Float[Tensor, "m 3"]) -> Float[Tensor, "m n 3"]:
        """Return where the seen points were before each motion [m]."""
        shifted = self.points - self.pivot - (motions[:, :2] @ self.axes)[:, None]
        return shifted @ rotation_from_vector(motions[:, 2:] * self.up) + self.pivot

    def cost(self, distance: Float[Tensor, "m n"]) -> Float[Tensor, "m"]:
        """Return the sum of Cauchy's costs of signed distances [m]."""
        return (distance / SCALE).square().log1p().sum(-1)

    def step(self, motions: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Return one Gauss-Newton step from each motion, with a weak prior for what the points do
        not tell.
        """
        # [m, m, rad]
        longest = motions.new_tensor([0.01, 0.01, 0.1])
        std = motions.new_tensor([0.05, 0.05, 0.2])
        before = self.undo(motions)
        distance, gradient = self.surface.query(before)
        arms = torch.linalg.cross(self.up.expand_as(before), before - self.pivot)
        along = self.axes @ rotation_from_vector(
            motions[:, 2:] * self.up
        )  # the axes before the turn
        rows = -torch.cat([gradient @ along.mT, (gradient * arms).sum(-1, keepdim=True)], -1)
        weighted = rows / (SCALE**2 + distance.square())[..., None]
        matrix = weighted.mT @ rows + torch.diag(std**-2)
        value = (weighted.mT @ distance[..., None])[..., 0]
        return torch.linalg.solve(matrix, -value - motions / std**2).clamp(-longest, longest)
