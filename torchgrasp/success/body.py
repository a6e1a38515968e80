"""The object as the planner estimates it, for predictions of success."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.surface import collision_field, extract_mesh


class EstimatedBody(NamedTuple):
    """What the planner knows of an object, in an upright frame, whose z axis points up.

    Args:
        shape: the posterior.
        vertices: of the estimated surface [m]; their mean is taken for the centre of mass.
        field: signed distances from the estimated surface.
    """

    shape: ShapeGP
    vertices: Float[Tensor, "v 3"]
    field: SignedDistanceField

    @classmethod
    def of(cls, shape: ShapeGP) -> "EstimatedBody":
        """Return the body of a shape in an upright frame."""
        mesh = extract_mesh(shape)
        return cls(shape, mesh.vertices, collision_field(shape, mesh))
