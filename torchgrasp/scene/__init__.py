"""Scenes: objects on a table as one camera saw them, with the free and the hidden space around them."""

from torchgrasp.scene.file import read_scene, save_scene
from torchgrasp.scene.occupancy import Occupancy, estimate_occupancy
from torchgrasp.scene.scene import Scene

__all__ = ["Occupancy", "Scene", "estimate_occupancy", "read_scene", "save_scene"]
