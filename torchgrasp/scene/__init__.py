"""Scenes: objects on a table as one camera saw them, with the free and the hidden space around
them.
"""

from torchgrasp.scene.occupancy import Occupancy, estimate_occupancy

__all__ = ["Occupancy", "estimate_occupancy"]
