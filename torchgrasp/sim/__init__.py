"""The simulated world: table, object and mounted hand in SAPIEN or MuJoCo."""

from torchgrasp.sim.convex_parts import convex_parts
from torchgrasp.sim.hand import SimulatedHand
from torchgrasp.sim.open import open_scene
from torchgrasp.sim.scene import Body, Neighbour, Scene, SceneSpec
from torchgrasp.sim.step_contacts import StepContacts

__all__ = ["Body", "Neighbour", "Scene", "SceneSpec", "SimulatedHand", "StepContacts", "convex_parts", "open_scene"]
