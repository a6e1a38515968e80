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
    """The planner's estimate of one object, or of one object for each entry of a batch of grasps.

    For a batch, all fields hold one value for each entry, along the leading axis `*b`. All vectors
    are in an upright frame: z points up.
    """

    shape: ShapeGP | ShapeBatch  # the estimated shape
    field: DistanceField  # signed distances [m] from the estimated surface
    # mean [m] of the surface's vertices, which is taken for the centre of mass
    center: Float[Tensor, "*b 3"]
    size: PerRow  # half the size [m] of the object: the length of a normalised unit
    height: PerRow  # extent [m] along z
    # standard deviation [m] of the vertices along their horizontal principal axis of less extent
    breadth: PerRow

    @classmethod
    def of(cls, shape: ShapeGP) -> "EstimatedBody":
        """Return the estimate of one object from its `shape`, which is in an upright frame: z
        points up. Surface mesh and distance field are computed from the shape.
        """
        mesh = extract_mesh(shape)
        return cls.around(shape, mesh.vertices, collision_field(shape, mesh))

    @classmethod
    def around(
        cls, shape: ShapeGP, vertices: Float[Tensor, "v 3"], field: DistanceField
    ) -> "EstimatedBody":
        """Return the estimate of one object from its `shape` and its known surface.

        `vertices` (v, 3) [m] are those of the surface's mesh, and `field` gives the signed
        distances [m] from it. All are in an upright frame: z points up.
        """
        center = vertices.mean(0)
        rise = vertices[:, 2].amax() - vertices[:, 2].amin()
        deviations = torch.linalg.svdvals(vertices[:, :2] - center[:2]) / math.sqrt(len(vertices))
        return cls(shape, field, center, shape.scale, float(rise), float(deviations[1]))

    def rows(self, index: Int[Tensor, "k"]) -> "EstimatedBody":
        """Return the estimates for some entries of the batch: those with the indices `index` (k,).

        If the estimate is of one object for all entries, the same estimate is returned.
        """
        numbers = (
            x[index] if isinstance(x, Tensor) and x.ndim else x
            for x in (self.size, self.height, self.breadth)
        )
        center = self.center if self.center.ndim == 1 else self.center[index]
        return EstimatedBody(rows_of(self.shape, index), self.field.rows(index), center, *numbers)
