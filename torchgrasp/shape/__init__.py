"""The object's surface as a Gaussian process over signed distance and normals."""

from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.shape.fit import condition
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.kernel import Kernel, matern52_kernel, rbf_kernel, thin_plate_kernel
from torchgrasp.shape.surface import Surface, extract_surface, surface_field
from torchgrasp.shape.second_view import NextView, next_view
from torchgrasp.shape.estimate import (
    JointEstimate,
    MeanJet,
    Normalisation,
    Observations,
    ShapeDerivatives,
    SurfaceJet,
)

__all__ = [
    "HollowShape",
    "JointEstimate",
    "Kernel",
    "MeanJet",
    "NextView",
    "Normalisation",
    "Observations",
    "ShapeDerivatives",
    "SignedDistanceField",
    "Surface",
    "SurfaceJet",
    "condition",
    "extract_surface",
    "matern52_kernel",
    "next_view",
    "rbf_kernel",
    "surface_field",
    "thin_plate_kernel",
]
