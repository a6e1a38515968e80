"""Point clouds: read, checked, merged, cleaned and prepared."""

from torchgrasp.cloud.advice import Advice
from torchgrasp.cloud.camera import look_at, partial_view
from torchgrasp.cloud.check import check_cloud, remove_duplicates
from torchgrasp.cloud.depth import cloud_from_depth, read_depth
from torchgrasp.cloud.diagnose import CloudReport, diagnose_cloud, format_report
from torchgrasp.cloud.filter import remove_outliers, voxel_downsample
from torchgrasp.cloud.io.read import cloud_from_array, read_cloud, read_cloud_file, save_cloud
from torchgrasp.cloud.io.rows import CloudFile
from torchgrasp.cloud.merge import merge_clouds
from torchgrasp.cloud.orientation import NormalCheck, check_normals, estimate_viewpoint
from torchgrasp.cloud.parts import cut_object
from torchgrasp.cloud.prepare import PreparedCloud, clean_cloud, estimate_normals, prepare_cloud

__all__ = [
    "Advice",
    "CloudFile",
    "CloudReport",
    "NormalCheck",
    "PreparedCloud",
    "check_cloud",
    "check_normals",
    "clean_cloud",
    "cloud_from_array",
    "cloud_from_depth",
    "cut_object",
    "diagnose_cloud",
    "estimate_normals",
    "estimate_viewpoint",
    "format_report",
    "look_at",
    "merge_clouds",
    "partial_view",
    "prepare_cloud",
    "read_cloud",
    "read_cloud_file",
    "read_depth",
    "remove_duplicates",
    "remove_outliers",
    "save_cloud",
    "voxel_downsample",
]
