"""A depth image from a connected RealSense, by Intel's package pyrealsense2."""

import contextlib
import dataclasses
import importlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torchgrasp.cloud.sensor import median_depth
from torchgrasp.foundation.errors import BadArgument, MissingExtra

CAMERA = "camera"
"""What errors call the camera."""


@dataclasses.dataclass(frozen=True)
class LiveCameraNumbers:
    """Parameters of the shot of a live camera."""

    settle: int = 30
    """Number of frames that are dropped first: the exposure settles within a second, of 30 frames.
    """
    frames: int = 9
    """Number of frames whose median is taken: the noise of single pixels falls to about a third."""
    queue: int = 2
    """Number of frames that wait in the queue; more would be old ones."""
    patience: int = 5000
    """Longest wait for a frame [ms]; a camera that starts needs up to 2 s."""


SHOT = LiveCameraNumbers()


class DepthShot(NamedTuple):
    """A depth image of a live camera.

    Attributes:
        depth: distance along the optical axis in counts, (h, w), integers; 0 is not measured.
        intrinsics: the pixels and the distortion of the camera, a pyrealsense2.intrinsics. It is an
            argument for `cloud_from_depth`.
        unit: metres of one count.
        camera: name and serial number.
    """

    depth: Tensor
    intrinsics: Any
    unit: float
    camera: str


def shoot_depth(serial: str | None = None, numbers: LiveCameraNumbers = SHOT) -> DepthShot:
    """Return the median of 9 depth frames (`SHOT.frames`) of a connected RealSense.

    Camera and scene must stand still meanwhile. The resolution is the camera's default. `serial` is
    the camera's serial number; None means the only camera. `numbers` count the frames and bound the
    waits. Raises `MissingExtra` without the package pyrealsense2. Raises `BadArgument` if this
    package cannot be loaded, or if not exactly one camera fits. It is raised, too, if the camera
    does not start, a frame does not come, or the view moves.
    """
    sdk = import_sdk()
    device = _choose(sdk, list_cameras(sdk), serial)
    camera = _describe(sdk, device)
    with _refusing(camera, "a camera that measures depth"):
        sensor = device.first_depth_sensor()
    profile = _find_mode(sdk, sensor, camera)
    queue = sdk.frame_queue(numbers.queue)
    with _refusing(camera, "a camera that no other program uses, at a USB port of its own"):
        sensor.open(profile)
    try:
        with _refusing(camera, "a camera that starts; plug it in anew"):
            sensor.start(queue)
        for _ in range(numbers.settle):
            _take(queue, camera, numbers)
        frames = [_take(queue, camera, numbers) for _ in range(numbers.frames)]
    finally:
        # a camera that was unplugged cannot be stopped
        with contextlib.suppress(RuntimeError):
            sensor.stop()
        with contextlib.suppress(RuntimeError):
            sensor.close()
    intrinsics = profile.as_video_stream_profile().get_intrinsics()
    return DepthShot(median_depth(frames), intrinsics, float(sensor.get_depth_scale()), camera)


def import_sdk() -> Any:
    """Return the module pyrealsense2.

    Raises `MissingExtra` if it is not installed, and `BadArgument` without its system library.
    """
    try:
        return importlib.import_module("pyrealsense2")
    except ModuleNotFoundError as error:
        raise MissingExtra("pyrealsense2", "realsense") from error
    except ImportError as error:
        fix = "the system library libusb (Debian and Ubuntu: apt-get install libusb-1.0-0)"
        raise BadArgument(CAMERA, f"a pyrealsense2 that cannot be loaded ({error})", fix) from error


def list_cameras(sdk: Any) -> list[Any]:
    """Return the connected RealSense cameras, as objects pyrealsense2.device.

    `sdk` is the module pyrealsense2.
    """
    return list(sdk.context().query_devices())


def _choose(sdk: Any, devices: list[Any], serial: str | None) -> Any:
    """Return the device with a serial number, or the only one."""
    if not devices:
        fix = "a RealSense at a USB port, which this user may open (udev rules)"
        raise BadArgument(CAMERA, "no connected camera", fix)
    known = {device.get_info(sdk.camera_info.serial_number): device for device in devices}
    if serial is None and len(known) == 1:
        return devices[0]
    if serial in known:
        return known[serial]
    found = f"{len(known)} connected cameras" if serial is None else serial
    raise BadArgument("serial", found, f"one of {', '.join(known)}")


def _describe(sdk: Any, device: Any) -> str:
    """Return name and serial number of a device."""
    kinds = (sdk.camera_info.name, sdk.camera_info.serial_number)
    return " ".join(device.get_info(kind) for kind in kinds if device.supports(kind))


def _find_mode(sdk: Any, sensor: Any, camera: str) -> Any:
    """Return the default depth mode of a sensor, else its first one."""
    modes = [
        mode
        for mode in sensor.get_stream_profiles()
        if mode.stream_type() == sdk.stream.depth and mode.format() == sdk.format.z16
    ]
    if not modes:
        raise BadArgument(CAMERA, f"{camera} without a depth mode", "a camera that measures depth")
    return next((mode for mode in modes if mode.is_default()), modes[0])


def _take(queue: Any, camera: str, numbers: LiveCameraNumbers) -> np.ndarray:
    """Return the counts (h, w) of the next frame, as a copy: the camera uses its memory again."""
    wait = f"a frame within {numbers.patience / 1000:g} s; plug the camera in anew"
    with _refusing(camera, wait):
        frame = queue.wait_for_frame(numbers.patience)
    return np.array(frame.get_data())


@contextlib.contextmanager
def _refusing(camera: str, allowed: str) -> Iterator[None]:
    """Within the context, turn an error of the camera into a `BadArgument`."""
    try:
        yield
    except RuntimeError as error:
        raise BadArgument(CAMERA, f"{camera}: {error}", allowed) from error
