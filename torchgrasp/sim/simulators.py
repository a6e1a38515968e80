"""The simulators behind `Scene`: each is imported when a scene is opened in it."""

from torchgrasp.checks import checked
from torchgrasp.sim.scene import Scene
from torchgrasp.sim.scene_spec import SceneSpec
from torchgrasp.specs import Simulator


@checked
def open_scene(spec: SceneSpec, simulator: Simulator = "sapien") -> Scene:
    """Return a fresh scene at its start.

    Raises:
        BadArgument: an unknown simulator, or a joint of the hand without a position or drive.
        HandFileError: the hand's URDF is not valid.
        MissingExtra: the simulator is not installed.

    >>> import numpy as np
    >>> from torchgrasp import load_hand, load_object
    >>> jug, hand = load_object("jug"), load_hand("barrett")
    >>> start, tips = dict.fromkeys(hand.tree.joint_names, 0.1), hand.tips.links
    >>> spec = SceneSpec(hand.urdf_path, np.eye(4), start, hand.actuators, tips, jug.mesh, jug.parts, mass=0.2)
    >>> open_scene(spec).object_pose().shape
    (4, 4)
    """
    if simulator == "mujoco":
        from torchgrasp.sim.mujoco_scene import MujocoScene

        return MujocoScene(spec)
    from torchgrasp.sim.sapien_scene import SapienScene

    return SapienScene(spec)
