"""What one camera saw of a table: things, their support, free and hidden space."""

from torchgrasp.scene.occupancy import Occupancy, estimate_occupancy
from torchgrasp.scene.file import read_scene, save_scene
from torchgrasp.scene.scene import DepthImage, Scene

__all__ = ["DepthImage", "Occupancy", "Scene", "read_scene", "save_scene", "estimate_occupancy"]
