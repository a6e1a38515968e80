"""torchgrasp: dexterous grasps from a partial point cloud, safe under the uncertainty of the unseen surface."""

__version__ = "0.1.0"
