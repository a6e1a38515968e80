#!/usr/bin/env bash
# pyrealsense2 2.55 to 2.59: add_to(context) announces a software device, yet no query of the context lists it.
# Its help still says "Any future queries on the context will return this device", as 2.54 did. Without it, pipelines find none.
# Packages: pyrealsense2 2.59.1.11053 and 2.54.2.5684 (right), libusb-package 1.0.30.0, numpy 2.4.6; Linux on x86-64, Python 3.11.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
cat > "$place/try.py" << 'END'
import ctypes
import time
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

# the wheel needs libusb of the system; this one comes as a package
ctypes.CDLL(str(Path(find_spec("libusb_package").origin).with_name("libusb-1.0.so")), mode=ctypes.RTLD_GLOBAL)
import pyrealsense2 as rs

context = rs.context()
announced = []
context.set_devices_changed_callback(lambda info: announced.append(len(info.get_new_devices())))
device = rs.software_device()
device.register_info(rs.camera_info.name, "software")
device.register_info(rs.camera_info.serial_number, "1234")
device.add_sensor("Stereo Module")
real = len(context.query_devices())
device.add_to(context)
for _ in range(50):
    if announced:
        break
    time.sleep(0.1)
every = 0x1FF  # all product lines, and those of software alone
listed = [len(context.query_devices()) - real, len(context.query_devices(every)) - real, len(context.devices) - real]
print("pyrealsense2", version("pyrealsense2"), "announced:", announced, "listed:", listed)
assert "Any future queries on the context will return this device" in device.add_to.__doc__
assert announced == [1]
assert listed == ([1, 1, 1] if version("pyrealsense2").startswith("2.54") else [0, 0, 0])
END
for version in 2.54.2.5684 2.59.1.11053; do
    "$place/bin/python" -m pip install -qq --disable-pip-version-check --no-deps "pyrealsense2==$version" libusb-package==1.0.30.0 numpy==2.4.6
    "$place/bin/python" "$place/try.py"
done
