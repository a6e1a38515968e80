"""What one camera saw of a table: objects, their support, free and hidden space."""

from torchgrasp.scene.occupancy import Occupancy, estimate_occupancy
from torchgrasp.scene.scene import Scene, read_scene, save_scene

__all__ = ["Occupancy", "Scene", "estimate_occupancy", "read_scene", "save_scene"]
