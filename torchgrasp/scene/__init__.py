"""What one camera saw of a table: things, their support, free and hidden space."""

from torchgrasp.scene.scene import DepthImage, Scene

__all__ = ["DepthImage", "Scene"]
