"""The side that the camera did not see: silhouettes, symmetry, free space."""

from torchgrasp.shape.completion.complete import Completion, complete_cloud
from torchgrasp.shape.completion.silhouette import Outlines, Silhouette, silhouettes

__all__ = ["Completion", "Outlines", "Silhouette", "complete_cloud", "silhouettes"]
