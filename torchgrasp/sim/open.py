"""The simulators of a scene by name, imported on demand."""

from torchgrasp.checks import checked
from torchgrasp.sim.scene import Scene, SceneSpec
from torchgrasp.specs import Simulator


@checked
def open_scene(spec: SceneSpec, simulator: Simulator = "sapien") -> Scene:
    """Return a fresh scene at its start.

    Raises:
        BadArgument: an unknown simulator, or a joint of the hand without a position or drive.
        HandFileError: the hand's URDF is no sound one.
        MissingExtra: the simulator is not installed.

    >>> from torchgrasp import load_hand, load_object
    >>> from torchgrasp.evaluation import GraspTrial, TrialDriver
    >>> from torchgrasp.data.shipped import load_shipped_grasp
    >>> from torchgrasp.specs import TrialSpec
    >>> jug, grasp = load_object("jug"), load_shipped_grasp("jug", "barrett")
    >>> driver = TrialDriver(GraspTrial(load_hand("barrett"), grasp, jug.mesh, parts=jug.parts), TrialSpec())
    >>> scene = open_scene(driver.scene_spec)
    >>> scene.step().finger, scene.object_pose().shape
    (array([False, False, False]), (4, 4))
    """
    if simulator == "mujoco":
        from torchgrasp.sim.mujoco_scene import MujocoScene

        return MujocoScene(spec)
    from torchgrasp.sim.sapien_scene import SapienScene

    return SapienScene(spec)
