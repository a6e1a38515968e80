"""Point clouds: read, checked, merged, cleaned and prepared."""

from torchgrasp.cloud.advice import Advice
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.check import check_cloud, remove_outliers, voxel_downsample
from torchgrasp.cloud.diagnose import CloudReport, diagnose_cloud, format_report
from torchgrasp.cloud.parts import cut_object
from torchgrasp.cloud.prepare import NormalCheck, estimate_normals
from torchgrasp.cloud.read import CloudFile, read_cloud_file, save_cloud
from torchgrasp.cloud.sensor import SensorNoise, median_depth

__all__ = [
    "Advice",
    "CloudFile",
    "CloudReport",
    "NormalCheck",
    "SensorNoise",
    "check_cloud",
    "cut_object",
    "diagnose_cloud",
    "estimate_normals",
    "format_report",
    "look_at",
    "median_depth",
    "partial_view",
    "read_cloud_file",
    "remove_outliers",
    "save_cloud",
    "voxel_downsample",
]
