"""The scene that a live camera sees, for `torchgrasp grasp --realsense`."""

from pathlib import Path

from torchgrasp.app.cli.command import naming
from torchgrasp.app.cli.inputs import CloudOptions, holding
from torchgrasp.app.report.scene_picture import draw_scene
from torchgrasp.cloud.pose import read_pose
from torchgrasp.cloud.realsense import shoot_depth
from torchgrasp.scene.file import save_scene
from torchgrasp.scene.scene import Scene

LIVE = "scene.npz"
"""Name of the file of a live camera's scene, in the output folder."""


def shoot_scene(out: Path, serial: str | None, view: CloudOptions) -> Path:
    """Take the depth image of a RealSense, write the scene and its picture into a folder; return
    the scene's path.

    `serial` is the serial number of the camera; None means the only one that is connected. `view`
    has the options for the table, the vertical and the camera's pose.

    Raises `BadArgument` without a camera that gives depth images, and for a table or a pose that
    the image contradicts. Raises `NoSupport` if no plane is found on which objects stand, and
    `MissingExtra` without pyrealsense2.
    """
    camera = dict.fromkeys(("camera", "depth", "intrinsics", "frames", "points"), "--realsense")
    options = {"camera_pose": "--camera-pose", "up": "--up", "table": "--table"}
    with naming(**camera, **options, serial="--serial"):
        pose = None if view.camera_pose is None else read_pose("camera_pose", view.camera_pose)
        given = {"table": view.given_table, "up": view.vertical}
        shot = shoot_depth(serial)
        scene = Scene.from_depth(shot.depth, shot.intrinsics, pose, **given, depth_unit=shot.unit)
    with holding("--out", out):
        path = save_scene(scene, out / LIVE)
        draw_scene(scene, path.with_suffix(".png"))
    seen = len(scene.pixels)
    print(f"camera  {shot.camera}: {seen} of {shot.depth.numel()} pixels measured, {path}")
    return path
