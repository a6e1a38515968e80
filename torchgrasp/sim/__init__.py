"""The simulated world: table, object and mounted hand in SAPIEN or MuJoCo."""

from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.sim.simulated_scene import SimulatedScene
from torchgrasp.sim.scene_spec import Neighbour, SceneSpec
from torchgrasp.sim.simulated_hand import SimulatedHand, open_scene

__all__ = [
    "Neighbour",
    "SimulatedScene",
    "SceneSpec",
    "SimulatedHand",
    "convex_parts",
    "open_scene",
]
