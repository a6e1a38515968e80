"""torchgrasp: dexterous grasps from a partial point cloud, safe under the uncertainty of the unseen surface.

The names below are the library, in the order in which data flows through them.
"""

from torchgrasp.errors import GraspError, Status
from torchgrasp.specs import ContactSpec, TrialSpec
from torchgrasp.values import (
    Certificate,
    ClosureResult,
    ContactCode,
    ContactPlan,
    Contacts,
    IKSeeds,
    Grasps,
    PointCloud,
    ShapeEstimate,
)
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.cloud.merge import merge_clouds
from torchgrasp.cloud.io.read import read_cloud
from torchgrasp.objects import list_objects, load_object
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.shape.fit import fit_shape
from torchgrasp.plan.solve import plan_contacts
from torchgrasp.plan.certify import certify
from torchgrasp.plan.closure_probability import closure_probability
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import load_hand
from torchgrasp.posture_model.encoding import encode
from torchgrasp.posture_model.fit import fit_mixture
from torchgrasp.posture_model.mixture import GraspMixture, load_mixture
from torchgrasp.ik.solve import solve_ik
from torchgrasp.pipeline import plan_grasps
from torchgrasp.values import load_grasps
from torchgrasp.control import closing_gains
from torchgrasp.evaluation.lift import close_hand

__version__ = "0.1.0"

__all__ = [
    "GraspError",
    "Status",
    "Certificate",
    "ClosureResult",
    "ContactCode",
    "ContactPlan",
    "Contacts",
    "ContactSpec",
    "IKSeeds",
    "Grasps",
    "PointCloud",
    "ShapeEstimate",
    "TrialSpec",
    "cloud_from_depth",
    "merge_clouds",
    "read_cloud",
    "list_objects",
    "load_object",
    "ShapeGP",
    "fit_shape",
    "plan_contacts",
    "certify",
    "closure_probability",
    "Hand",
    "load_hand",
    "encode",
    "fit_mixture",
    "GraspMixture",
    "load_mixture",
    "solve_ik",
    "plan_grasps",
    "load_grasps",
    "closing_gains",
    "close_hand",
]
