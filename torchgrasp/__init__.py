"""torchgrasp: dexterous grasps from a partial point cloud, safe under the uncertainty of the unseen surface.

The names below are the library, in the order of the data flow. Each subpackage names the rest of its public things.
"""

from torchgrasp.errors import GraspError, Status
from torchgrasp.geometry.plane import Plane
from torchgrasp.specs import ContactSpec, SensorModel, TrialSpec
from torchgrasp.values import (
    Certificate,
    ContactCode,
    ContactPlan,
    Contacts,
    Grasps,
    IKSeeds,
    PointCloud,
    ShapeEstimate,
    load_grasps,
)
from torchgrasp.closure import ClosingGains, ClosingTrace, ClosureResult, Disturbance, ObjectMotion
from torchgrasp.cloud import cloud_from_depth, merge_clouds, read_cloud
from torchgrasp.scene import Scene, read_scene, save_scene
from torchgrasp.data.shipped import GraspObject, list_objects, load_object, load_scene
from torchgrasp.shape import ShapeGP, fit_shape
from torchgrasp.plan import ClosureProbability, certify, closure_probability, plan_contacts
from torchgrasp.hand import Hand, hand_of, load_hand
from torchgrasp.posture_model import (
    GraspMixture,
    HandSamples,
    encode,
    fit_mixture,
    load_mixture,
    load_samples,
    sample_configurations,
)
from torchgrasp.ik import IKSolution, PostureLibrary, SignedDistanceField, solve_ik, surface_field
from torchgrasp.planner import ScenePlan, ThingPlan, explain_empty, plan_grasps, plan_scene, stream_grasps
from torchgrasp.control import ClosingReference, GraspController, closing_gains
from torchgrasp.sim import Neighbour
from torchgrasp.evaluation import close_hand

__version__ = "0.1.0"

__all__ = [
    "GraspError",
    "Status",
    "Plane",
    "ContactSpec",
    "SensorModel",
    "SignedDistanceField",
    "TrialSpec",
    "Certificate",
    "ClosingGains",
    "ClosingTrace",
    "ClosureResult",
    "ContactCode",
    "ContactPlan",
    "Contacts",
    "Disturbance",
    "Grasps",
    "IKSeeds",
    "ObjectMotion",
    "PointCloud",
    "ShapeEstimate",
    "load_grasps",
    "cloud_from_depth",
    "merge_clouds",
    "read_cloud",
    "Scene",
    "read_scene",
    "save_scene",
    "GraspObject",
    "list_objects",
    "load_object",
    "load_scene",
    "ShapeGP",
    "fit_shape",
    "ClosureProbability",
    "certify",
    "closure_probability",
    "plan_contacts",
    "Hand",
    "hand_of",
    "load_hand",
    "GraspMixture",
    "HandSamples",
    "encode",
    "fit_mixture",
    "load_mixture",
    "load_samples",
    "sample_configurations",
    "IKSolution",
    "PostureLibrary",
    "solve_ik",
    "surface_field",
    "plan_grasps",
    "stream_grasps",
    "explain_empty",
    "ScenePlan",
    "ThingPlan",
    "plan_scene",
    "ClosingReference",
    "GraspController",
    "closing_gains",
    "Neighbour",
    "close_hand",
]
