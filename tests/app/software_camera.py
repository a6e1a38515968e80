"""Runs `torchgrasp grasp --realsense` on software devices of pyrealsense2; prints what it saw as
JSON.

The words are the folder for the results, and the depth image to show, in counts (.npy). The folder
has pose.npy, the camera's pose.
"""

import contextlib
import ctypes
import importlib.util
import io
import json
import sys
import threading
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from torchgrasp.app import cli
from torchgrasp.app.cli.grasp import Grasp
from torchgrasp.cloud import realsense
from torchgrasp.cloud.camera import INTRINSICS
from torchgrasp.cloud.realsense import LiveCameraNumbers, shoot_depth
from torchgrasp.foundation.errors import BadArgument

# a machine without libusb loads the one of the package
spec = importlib.util.find_spec("libusb_package")
ctypes.CDLL(str(Path(spec.origin).with_name("libusb-1.0.so")), mode=ctypes.RTLD_GLOBAL)

import pyrealsense2 as rs  # noqa: E402

UNIT = 0.0005  # metres of one count
DARK = 10  # frames at the start, in which nothing is measured


class Camera:
    """A software device that shows a depth image, and the same again until it is stopped."""

    def __init__(self, counts, serial="1", model=None, coefficients=(0.0,) * 5, moves=False):
        self.counts = counts
        self.moves = moves
        height, width = counts.shape
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software RealSense")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.sensor = self.device.add_sensor("Stereo Module")
        k = (INTRINSICS / 2).tolist()  # of every second pixel
        pixels = rs.intrinsics()
        pixels.width = width
        pixels.height = height
        pixels.fx = k[0][0]
        pixels.fy = k[1][1]
        pixels.ppx = k[0][2]
        pixels.ppy = k[1][2]
        pixels.model = model or rs.distortion.brown_conrady
        pixels.coeffs = list(coefficients)
        stream = rs.video_stream()
        stream.type = rs.stream.depth
        stream.fmt = rs.format.z16
        stream.index = 0
        stream.uid = 0
        stream.width = width
        stream.height = height
        stream.fps = 30
        stream.bpp = 2
        stream.intrinsics = pixels
        self.profile = self.sensor.add_video_stream(stream, True)
        self.sensor.add_read_only_option(rs.option.depth_units, UNIT)

    def feed(self, ended):
        """Show frames until the event `ended`; the first ones are dark."""
        number = 0
        while not ended.wait(0.004):
            frame = rs.software_video_frame()
            shown = self.counts * (number >= DARK)
            if self.moves:
                shown = np.roll(shown, 10 * number, axis=1)
            frame.pixels = np.ascontiguousarray(shown, dtype=np.uint16)
            frame.bpp = 2
            frame.stride = 2 * shown.shape[1]
            frame.timestamp = 33.0 * number
            frame.domain = rs.timestamp_domain.hardware_clock
            frame.frame_number = number
            frame.profile = self.profile.as_video_stream_profile()
            self.sensor.on_video_frame(frame)
            number += 1


@contextlib.contextmanager
def connected(*cameras):
    """Within the context, these cameras are connected and show their images."""
    ended = threading.Event()
    threads = [threading.Thread(target=camera.feed, args=(ended,)) for camera in cameras]
    realsense.list_cameras = lambda sdk: [camera.device for camera in cameras]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()


def run(*words):
    """Return the exit code of the command, and what it printed on either stream."""
    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(["grasp", "--hand", "barrett", "--starts", "8", *words])
    return code, out.getvalue(), err.getvalue()


def main(folder, file):
    """Print the results of all cases."""
    counts = np.load(file)
    found: dict[str, Any] = {"real": len(realsense.list_cameras(rs))}
    with connected():
        found["unplugged"] = run("--realsense", "--out", f"{folder}/none")
    with connected(Camera(counts)):
        found["good"] = run("--realsense", "--out", f"{folder}/good", "--no-report")
        # the frame alone counts
        with mock.patch.object(Grasp, "_grasp_scene", return_value=0):
            posed = ("--camera-pose", f"{folder}/pose.npy", "--out", f"{folder}/posed")
            found["posed"] = run("--realsense", *posed)
        found["again"] = shoot_depth("1").camera  # the camera was closed
    with connected(Camera(counts, "1"), Camera(counts, "2")):
        found["two"] = run("--realsense", "--out", f"{folder}/none")
        found["second"] = shoot_depth("2").camera
        found["unknown"] = run("--realsense", "--serial", "3", "--out", f"{folder}/none")
    bent = rs.distortion.inverse_brown_conrady
    with connected(Camera(counts, model=bent, coefficients=(0.1, 0.0, 0.0, 0.0, 0.0))):
        found["bent"] = run("--realsense", "--out", f"{folder}/none")
    with connected(Camera(counts, moves=True)):
        found["moved"] = run("--realsense", "--out", f"{folder}/none")
    still = Camera(counts)
    realsense.list_cameras = lambda sdk: [still.device]
    began = time.monotonic()
    try:
        shoot_depth(numbers=LiveCameraNumbers(patience=100))
    except BadArgument as error:
        found["still"] = str(error), time.monotonic() - began
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
