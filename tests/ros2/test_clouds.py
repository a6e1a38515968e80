"""A PointCloud2 of any layout is read: packed by hand with struct, through an .mcap file."""

import struct

import messages
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.ros2 import bags

FLOAT32 = 7
FLOAT64 = 8
UINT32 = 6
POINTS = [
    (0.1, -0.2, 0.3),
    (1.5, 2.25, -3.0),
    (0.0, 0.125, 8.0),
    (4.0, 5.0, 6.0),
    (-7.0, 0.5, 2.0),
    (1.0, 1.0, 1.0),
]


def cloud(fields, step, pack, points=POINTS, height=1, padding=0, big=False, dense=True):
    """A message whose points are written one by one, into rows with unused bytes at their ends."""
    width = len(points) // height
    data = bytearray()
    for row in range(height):
        for point in points[row * width : (row + 1) * width]:
            record = pack(*point)
            data += record + b"\xee" * (step - len(record))
        data += b"\xdd" * padding
    return bags.message(
        "sensor_msgs/PointCloud2",
        header=bags.header("camera"),
        height=height,
        width=width,
        fields=[
            bags.message("sensor_msgs/PointField", name=name, offset=at, datatype=kind, count=1)
            for name, at, kind in fields
        ],
        is_bigendian=big,
        point_step=step,
        row_step=width * step + padding,
        data=np.frombuffer(bytes(data), np.uint8),
        is_dense=dense,
    )


XYZ = [("x", 0, FLOAT32), ("y", 4, FLOAT32), ("z", 8, FLOAT32)]
LAYOUTS = {
    "packed": (XYZ, 12, lambda *p: struct.pack("<fff", *p), {}),
    "of PCL, with padding and colour": (
        [*XYZ, ("rgb", 16, FLOAT32)],
        32,
        lambda *p: struct.pack("<fff", *p),
        {},
    ),
    "organised, rows with ends": (
        XYZ,
        16,
        lambda *p: struct.pack("<fff", *p),
        {"height": 2, "padding": 8},
    ),
    "double, after an intensity": (
        [("intensity", 0, FLOAT32), ("z", 20, FLOAT64), ("x", 4, FLOAT64), ("y", 12, FLOAT64)],
        48,
        lambda x, y, z: struct.pack("<fddd", 5.0, x, y, z),
        {},
    ),
    "big-endian": (XYZ, 12, lambda *p: struct.pack(">fff", *p), {"big": True}),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_points_of_each_layout_are_read(layout, tmp_path):
    fields, step, pack, more = LAYOUTS[layout]
    (read,) = bags.through_mcap(
        tmp_path / "bag", "sensor_msgs/PointCloud2", cloud(fields, step, pack, **more)
    )
    np.testing.assert_array_equal(
        messages.read_points(read), np.array(POINTS, "f4" if step != 48 else "f8")
    )


def test_pixels_without_depth_are_left_out():
    nan = float("nan")
    inf = float("inf")
    holes = [*POINTS[:2], (nan, nan, nan), POINTS[2], (0.0, 0.0, inf), POINTS[3]]
    read = messages.read_points(
        cloud(XYZ, 16, lambda *p: struct.pack("<fff", *p), holes, height=2, dense=False)
    )
    np.testing.assert_array_equal(read, np.array(POINTS[:4], "f4"))


@pytest.mark.parametrize("fields", [XYZ[:2], [*XYZ[:2], ("z", 8, UINT32)]])
def test_a_cloud_without_coordinates_is_refused(fields):
    with pytest.raises(ValueError, match="x, y and z as floats"):
        messages.read_points(cloud(fields, 12, lambda *p: struct.pack("<fff", *p)))


def test_a_cloud_that_was_cut_short_is_refused():
    short = cloud(XYZ, 12, lambda *p: struct.pack("<fff", *p))
    short.data = short.data[:-1]
    with pytest.raises(ValueError, match="71 bytes"):
        messages.read_points(short)


def test_points_and_camera_come_into_the_frame_of_gravity():
    turn = Rotation.from_euler("xyz", [0.3, -0.5, 1.2])
    place = np.array([0.4, -0.1, 0.9])
    x, y, z, w = turn.as_quat()
    transform = bags.message(
        "geometry_msgs/Transform",
        translation=bags.message("geometry_msgs/Vector3", x=0.4, y=-0.1, z=0.9),
        rotation=bags.message("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
    )
    pose = messages.read_transform(transform)
    read = messages.read_cloud(
        cloud(XYZ, 12, lambda *p: struct.pack("<fff", *p)), pose, pose[:3, 3]
    )
    np.testing.assert_allclose(read.points, turn.apply(np.array(POINTS, "f4")) + place, atol=1e-12)
    assert torch.equal(read.viewpoint, torch.from_numpy(place))
