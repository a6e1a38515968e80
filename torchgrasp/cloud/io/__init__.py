"""Point-cloud files: PLY, PCD, NumPy and text."""

from torchgrasp.cloud.io.read import read_cloud, save_cloud

__all__ = ["read_cloud", "save_cloud"]
