"""What one camera saw of a table: objects, their support, free and hidden space."""

from torchgrasp.scene.file import read_scene, save_scene
from torchgrasp.scene.occupancy import Occupancy, estimate_occupancy
from torchgrasp.scene.scene import Scene

__all__ = ["Occupancy", "Scene", "estimate_occupancy", "read_scene", "save_scene"]
