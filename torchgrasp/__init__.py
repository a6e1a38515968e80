"""Dexterous grasps from a partial point cloud, robust to the uncertainty of the unseen surface.

The names below are the core of the library, in the order of the data flow. Each subpackage has more public names.
"""

from torchgrasp.errors import GraspError, Status
from torchgrasp.geometry.plane import Plane
from torchgrasp.specs import ContactSpec, TrialSpec
from torchgrasp.values import Certificate, ContactCode, ContactPlan, Contacts, Grasps, PointCloud, ShapeEstimate
from torchgrasp.closure import ClosureResult, SensorModel
from torchgrasp.cloud import cloud_from_array, cloud_from_depth, merge_clouds, read_cloud
from torchgrasp.scene import Scene, read_scene, save_scene
from torchgrasp.data.shards import load_grasps
from torchgrasp.data.shipped import list_objects, load_object, load_scene
from torchgrasp.shape import ShapeGP, fit_shape
from torchgrasp.plan import Region, certify, closure_probability, plan_contacts
from torchgrasp.hand import Hand, load_hand
from torchgrasp.posture_model import GraspMixture, encode, fit_mixture, load_mixture, sample_configurations
from torchgrasp.ik import solve_ik
from torchgrasp.success import GraspTask, explain_success
from torchgrasp.planner import explain_empty, plan_grasps, plan_scene, stream_grasps
from torchgrasp.control import ClosingReference, GraspController, closing_gains
from torchgrasp.evaluation import close_hand

__version__ = "0.1.0"

__all__ = [
    "plan_grasps", "GraspError", "Status", "Plane", "ContactSpec", "SensorModel", "TrialSpec",
    "Certificate", "ClosureResult", "ContactCode", "ContactPlan", "Contacts", "Grasps", "PointCloud", "ShapeEstimate",
    "load_grasps", "cloud_from_array", "cloud_from_depth", "merge_clouds", "read_cloud", "Scene", "read_scene",
    "save_scene", "list_objects", "load_object", "load_scene", "ShapeGP", "fit_shape",
    "Region", "certify", "closure_probability", "plan_contacts", "Hand", "load_hand",
    "GraspMixture", "encode", "fit_mixture", "load_mixture", "sample_configurations",
    "solve_ik", "GraspTask", "explain_success", "stream_grasps", "explain_empty", "plan_scene",
    "ClosingReference", "GraspController", "closing_gains", "close_hand",
]  # fmt: skip


def __dir__() -> list[str]:
    """List the public names."""
    return [*__all__, "__version__"]
