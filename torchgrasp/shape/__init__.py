"""The object's surface as a Gaussian process over signed distance and normals."""

from torchgrasp.geometry.signed_distance import SignedDistanceField
from torchgrasp.shape.fit import condition
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.kernel import Kernel, matern52_kernel, rbf_kernel, thin_plate_kernel
from torchgrasp.shape.surface import Surface, extract_surface, surface_field
from torchgrasp.shape.estimate import JointEstimate, Normalisation, Observations, ShapeDerivatives

__all__ = [
    "HollowShape",
    "JointEstimate",
    "Kernel",
    "Normalisation",
    "Observations",
    "ShapeDerivatives",
    "SignedDistanceField",
    "Surface",
    "condition",
    "extract_surface",
    "matern52_kernel",
    "rbf_kernel",
    "surface_field",
    "thin_plate_kernel",
]
