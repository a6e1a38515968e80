"""The object as the planner estimates it, for predictions of success."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchgrasp.contacts.problem import PerRow, rows_of
from torchgrasp.geometry.signed_distance import DistanceField
from torchgrasp.shape.batch import ShapeBatch
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import collision_field, extract_mesh


class EstimatedBody(NamedTuple):
    """What the planner knows of an object, or of the object of each row, in an upright frame: its z
    axis points up.
    """

    shape: ShapeGP | ShapeBatch
    field: DistanceField  # of the estimated surface
    center: Float[
        Tensor, "*b 3"
    ]  # the mean [m] of the surface's vertices, which is taken for the centre of mass
    size: PerRow  # half the size [m]: the length of a normalised unit
    height: PerRow  # extent [m] along z
    breadth: PerRow  # lesser deviation [m] of the vertices in the plane across z

    @classmethod
    def of(cls, shape: ShapeGP) -> "EstimatedBody":
        """Return the body of a shape in an upright frame."""
        mesh = extract_mesh(shape)
        return cls.around(shape, mesh.vertices, collision_field(shape, mesh))

    @classmethod
    def around(
        cls, shape: ShapeGP, vertices: Float[Tensor, "v 3"], field: DistanceField
    ) -> "EstimatedBody":
        """Return the body of a shape with the given vertices [m] of its surface, and distances from
        the surface.
        """
        center = vertices.mean(0)
        rise = vertices[:, 2].amax() - vertices[:, 2].amin()
        deviations = torch.linalg.svdvals(vertices[:, :2] - center[:2]) / math.sqrt(len(vertices))
        return cls(shape, field, center, shape.scale, float(rise), float(deviations[1]))

    def rows(self, index: Int[Tensor, "k"]) -> "EstimatedBody":
        """Return the bodies of some of the rows; a single body is that of all rows."""
        numbers = (
            x[index] if isinstance(x, Tensor) and x.ndim else x
            for x in (self.size, self.height, self.breadth)
        )
        center = self.center if self.center.ndim == 1 else self.center[index]
        return EstimatedBody(rows_of(self.shape, index), self.field.rows(index), center, *numbers)
