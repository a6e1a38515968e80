"""Dexterous grasps from a partial point cloud, robust to the uncertainty of the unseen surface.

The names below are the core of the library, in the order of the data flow. Each subpackage has more
public names.
"""

from torchgrasp.foundation.garbage import uncollected as _uncollected
from torchgrasp.foundation.lazy import module_late as _module_late

with _uncollected():
    from torchgrasp.foundation.errors import GraspError, Status
    from torchgrasp.geometry.plane import Plane
    from torchgrasp.values.distribution import Distribution
    from torchgrasp.values.specs import ContactSpec, TrialSpec
    from torchgrasp.values.planning import (
        Certificate,
        ContactCode,
        ContactPlan,
        Contacts,
        Grasps,
        PointCloud,
        ShapeEstimate,
    )
    from torchgrasp.values.closing import ClosureResult, SensorModel
    from torchgrasp.cloud.read import cloud_from_array, read_cloud
    from torchgrasp.cloud.depth import cloud_from_depth
    from torchgrasp.cloud.prepare import merge_clouds
    from torchgrasp.scene.scene import Scene
    from torchgrasp.scene.file import read_scene, save_scene
    from torchgrasp.data.shards import load_grasps
    from torchgrasp.data.shipped import list_objects, load_object, load_scene
    from torchgrasp.shape.gp import ShapeGP
    from torchgrasp.shape.fit import fit_shape
    from torchgrasp.contacts.region import Region
    from torchgrasp.contacts.certify import certify
    from torchgrasp.contacts.closure_probability import closure_probability
    from torchgrasp.contacts.critical import critical_friction
    from torchgrasp.contacts.hold_probability import CarriedWeight, hold_probability
    from torchgrasp.contacts.plan import plan_contacts
    from torchgrasp.hand.hand import Hand
    from torchgrasp.hand.load import load_hand
    from torchgrasp.posture_model.mixture import GraspMixture, encode, load_mixture
    from torchgrasp.posture_model.training import fit_mixture
    from torchgrasp.posture_model.sample import sample_configurations
    from torchgrasp.ik.solve import solve_ik
    from torchgrasp.success.task import GraspTask
    from torchgrasp.success.reasons import explain_success
    from torchgrasp.planner.edge import plan_edge_grasps
    from torchgrasp.planner.explain import explain_empty
    from torchgrasp.planner.grasps import plan_grasps, stream_grasps
    from torchgrasp.planner.scene_plan import plan_scene
    from torchgrasp.control.reference import ClosingReference, closing_gains
    from torchgrasp.control.controller import GraspController
    from torchgrasp.evaluation.lift import close_hand

# grasps show themselves in notebooks; what draws them needs all stages
Grasps.pages = _module_late("torchgrasp.app.report.notebook")

__version__ = "0.1.0"

__all__ = [
    "plan_grasps",
    "GraspError",
    "Status",
    "Plane",
    "Distribution",
    "ContactSpec",
    "SensorModel",
    "TrialSpec",
    "Certificate",
    "ClosureResult",
    "ContactCode",
    "ContactPlan",
    "Contacts",
    "Grasps",
    "PointCloud",
    "ShapeEstimate",
    "load_grasps",
    "cloud_from_array",
    "cloud_from_depth",
    "merge_clouds",
    "read_cloud",
    "Scene",
    "read_scene",
    "save_scene",
    "list_objects",
    "load_object",
    "load_scene",
    "ShapeGP",
    "fit_shape",
    "Region",
    "certify",
    "closure_probability",
    "critical_friction",
    "CarriedWeight",
    "hold_probability",
    "plan_contacts",
    "Hand",
    "load_hand",
    "GraspMixture",
    "encode",
    "fit_mixture",
    "load_mixture",
    "sample_configurations",
    "solve_ik",
    "GraspTask",
    "explain_success",
    "stream_grasps",
    "explain_empty",
    "plan_scene",
    "plan_edge_grasps",
    "ClosingReference",
    "GraspController",
    "closing_gains",
    "close_hand",
]


def __dir__() -> list[str]:
    """List the public names."""
    return [*__all__, "__version__"]
