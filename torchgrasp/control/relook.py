"""A second look at an object: how far it has moved since its surface was estimated."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply, inverse, rotation_from_vector, turned_about
from torchgrasp.geometry.linalg import across, matvec, unit
from torchgrasp.geometry.plane import Plane
from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.values.planning import PointCloud

REACH = 0.08  # largest displacement [m] on each axis of the table that `relocate` tries at first


@dataclasses.dataclass(frozen=True)
class RelookNumbers:
    """Parameters of `relocate`, the search for the object's motion from a new view.

    A motion is a shift (x, y) [m] along the table and a rotation [rad] about its normal. The search
    tries a grid of motions, and improves the best ones by Gauss-Newton steps.
    """

    scale: float = 0.004
    """Scale s [m] of Cauchy's cost: points farther than this from the surface count less."""
    points: int = 300
    """Greatest number of points of the new cloud that are used."""
    shifts: int = 17
    """Number of shifts of the grid on each axis of the table, from -80 mm to 80 mm (`REACH`)."""
    turns: int = 7
    """Number of rotations of the grid."""
    farthest: float = 0.52
    """Largest rotation [rad] of the grid: 30 degrees."""
    best: int = 16
    """Number of motions of the grid from which steps start."""
    steps: int = 20
    """Number of Gauss-Newton steps from each of them."""
    longest: tuple[float, float, float] = (0.01, 0.01, 0.1)
    """Largest change of each component of a motion in one step [m, m, rad]."""
    std: tuple[float, float, float] = (0.05, 0.05, 0.2)
    """Standard deviations of a motion under the weak prior [m, m, rad]."""
    off: float = 0.05
    """Largest median distance [m] of the new points from the moved surface: beyond it the points
    are in another frame or unit, not of the object alone, or too far away.
    """


RELOOK = RelookNumbers()


@checked
def relocate(surface: SignedDistanceField, cloud: PointCloud, table: Plane) -> Float[Tensor, "4 4"]:
    """Return the motion (4, 4) of an object along its table since its surface was estimated.

    It is a rigid transform [m] of old to new points, in the frame that all arguments share. It is a
    shift along the table and a rotation about its normal. The motion minimises the sum of log(1 +
    (d_i / s)^2). Here d_i are the signed distances of the new points from the moved surface, and s
    = 4 mm. This is Cauchy's cost, which outliers hardly change. A grid search to 80 mm and 30
    degrees starts Gauss-Newton steps.

    Args:
        surface: the estimated surface (`surface_field`).
        cloud: a new cloud of the object alone [m].
        table: the table.
    """
    count = min(len(cloud), RELOOK.points)
    rows = torch.linspace(0, len(cloud) - 1, count, dtype=torch.float32).round().long()
    search = _Registration(surface, cloud.points[rows], table)
    line = torch.linspace(-REACH, REACH, RELOOK.shifts, dtype=torch.float64)
    turns = torch.linspace(-RELOOK.farthest, RELOOK.farthest, RELOOK.turns, dtype=torch.float64)
    motions = torch.cartesian_prod(line, line, turns)  # (m, 3)
    # distances at grid nodes are rough, but fast
    rough = search.cost(surface.nearest_node(search.undo(motions)))
    motions = motions[rough.argsort()[: RELOOK.best]]
    for _ in range(RELOOK.steps):
        motions = motions + search.step(motions)
    distance, _ = surface.query(search.undo(motions))
    found = motions[search.cost(distance).argmin()]
    rotation = rotation_from_vector(found[2] * search.up)
    return turned_about(rotation, search.pivot, found[:2] @ search.axes)


def check_seen_again(
    surface: SignedDistanceField, cloud: PointCloud, moved: Float[Tensor, "4 4"]
) -> None:
    """Raise `BadArgument` for a new cloud that is far off the surface, though this was `moved`
    (`relocate`).
    """
    distance, _ = surface.query(apply(inverse(moved), cloud.points.double().cpu()))
    off = float(distance.abs().median())
    if off > RELOOK.off:
        found = f"points that are {1000 * off:.0f} mm off the object, wherever it stands"
        allowed = "points in metres of the object alone, in the frame of the planned cloud"
        raise BadArgument("cloud", found, allowed)


class _Registration:
    """The costs of motions (m, 3) of an object: two shifts [m] along the table, and a rotation
    [rad] about its normal.
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
        """Return where the n points of the new view were before each of m motions [m]."""
        shifted = self.points - self.pivot - (motions[:, :2] @ self.axes)[:, None]
        return shifted @ rotation_from_vector(motions[:, 2:] * self.up) + self.pivot

    def cost(self, distance: Float[Tensor, "m n"]) -> Float[Tensor, "m"]:
        """Return the sum of Cauchy's costs of the signed distances [m] of n points, for each of m
        motions.
        """
        return (distance / RELOOK.scale).square().log1p().sum(-1)

    def step(self, motions: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
        """Return one Gauss-Newton step from each motion; a weak prior holds motions that the points
        do not determine.
        """
        longest = motions.new_tensor(RELOOK.longest)
        std = motions.new_tensor(RELOOK.std)
        before = self.undo(motions)
        distance, gradient = self.surface.query(before)
        arms = torch.linalg.cross(self.up.expand_as(before), before - self.pivot)
        # the axes before the turn: (m, 2, 3)
        along = self.axes @ rotation_from_vector(motions[:, 2:] * self.up)
        turning = (gradient * arms).sum(-1, keepdim=True)
        rows = -torch.cat([gradient @ along.mT, turning], -1)  # (m, n, 3)
        weighted = rows / (RELOOK.scale**2 + distance.square())[..., None]
        matrix = weighted.mT @ rows + torch.diag(std**-2)
        value = matvec(weighted.mT, distance)
        return torch.linalg.solve(matrix, -value - motions / std**2).clamp(-longest, longest)
