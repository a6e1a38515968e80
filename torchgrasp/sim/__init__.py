"""The simulated world: table, object and mounted hand in SAPIEN or MuJoCo."""

from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.sim.simulated_scene import SimulatedScene, StepContacts
from torchgrasp.sim.scene_spec import Body, Neighbour, SceneSpec, Slide
from torchgrasp.sim.simulated_hand import SimulatedHand, open_scene

__all__ = [
    "Body",
    "Neighbour",
    "SimulatedScene",
    "SceneSpec",
    "SimulatedHand",
    "Slide",
    "StepContacts",
    "convex_parts",
    "open_scene",
]
