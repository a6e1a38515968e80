"""The object's surface as a Gaussian process over signed distance and normals."""

from torchgrasp.shape.condition import condition
from torchgrasp.shape.fit import fit_shape
from torchgrasp.shape.gp import Normalisation, ShapeDerivatives, ShapeGP
from torchgrasp.shape.hollow import HollowShape
from torchgrasp.shape.joint_posterior import JointEstimate
from torchgrasp.shape.kernel import Kernel, kernel_by_name, matern52_kernel, rbf_kernel, thin_plate_kernel
from torchgrasp.shape.observations import Observations
from torchgrasp.shape.posterior import MeanJet, SurfaceJet
from torchgrasp.shape.surface import Surface, extract_surface

__all__ = [
    "HollowShape",
    "JointEstimate",
    "Kernel",
    "MeanJet",
    "Normalisation",
    "Observations",
    "ShapeDerivatives",
    "ShapeGP",
    "Surface",
    "SurfaceJet",
    "condition",
    "extract_surface",
    "fit_shape",
    "kernel_by_name",
    "matern52_kernel",
    "rbf_kernel",
    "thin_plate_kernel",
]
