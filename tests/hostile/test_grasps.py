"""Hostile files of grasps: whatever they hold, they are refused by name, and no error comes from
inside.
"""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from torchgrasp import load_grasps, load_object, plan_grasps
from torchgrasp.app import cli
from torchgrasp.cloud.read import read_cloud
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.hand.load import load_hand
from torchgrasp.scene.file import read_scene
from torchgrasp.values.planning import Grasps


@pytest.fixture(scope="module")
def grasps() -> Grasps:
    return plan_grasps(load_object("cylinder").view, load_hand("barrett"), starts=12)


def write(path: Path, tensors: dict[str, torch.Tensor], meta: Any) -> Path:
    """Write a file as a stranger would; `meta` as JSON unless it is a text."""
    text = meta if isinstance(meta, str) else json.dumps(meta)
    save_file({name: x.contiguous() for name, x in tensors.items()}, path, {"torchgrasp": text})
    return path


def header(grasps: Grasps, **changes: Any) -> dict[str, Any]:
    return grasps.meta | {"kind": "grasps", "version": "1"} | changes


SHAPES = {
    "one more axis": lambda x: x[..., None].expand(*x.shape, 2),
    "one column": lambda x: x.reshape(len(x), -1)[:, :1],
    "no rows": lambda x: x[:0],
    "one row more": lambda x: torch.cat([x, x[:1]]),
    "a scalar": lambda x: x.flatten()[0],
    "half": lambda x: x.half(),
    "complex": lambda x: x.to(torch.complex64),
    "float8": lambda x: x.float().to(torch.float8_e4m3fn),
    "bytes": lambda x: x.to(torch.uint8),
    "NaN": lambda x: torch.full(x.shape, torch.nan),
}


def test_a_good_file_is_read(tmp_path: Path, grasps: Grasps):
    tensors = named_tensors(grasps)
    again = load_grasps(write(tmp_path / "g.safetensors", tensors, header(grasps)))
    assert (
        all(torch.equal(x, tensors[name]) for name, x in named_tensors(again).items())
        and again.meta == grasps.meta
    )


@pytest.mark.promise("H4")
@pytest.mark.parametrize("change", SHAPES)
def test_a_tensor_of_another_shape_or_type_is_refused_by_name(
    tmp_path: Path, grasps: Grasps, change: str
):
    for name, tensor in named_tensors(grasps).items():
        wrong = named_tensors(grasps) | {name: SHAPES[change](tensor)}
        with pytest.raises(ModelFileError, match="expected "):
            load_grasps(write(tmp_path / "g.safetensors", wrong, header(grasps)))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("obj_from_hand", lambda x: 3 * x, "not rigid"),
        ("obj_from_hand", lambda x: 0 * x, "not rigid"),
        (
            "obj_from_hand",
            lambda x: x * torch.tensor([-1.0, 1, 1, 1], dtype=x.dtype)[:, None],
            "not rigid",
        ),
        (
            "obj_from_hand",
            lambda x: x + torch.tensor([0, 0, 0, 1.0], dtype=x.dtype)[:, None],
            "not rigid",
        ),
        ("status", lambda x: x + 9999, "status"),
        ("status", lambda x: x - 1, "status"),
        ("permutation", lambda x: 0 * x, "permutation"),
        ("permutation", lambda x: x + 7, "permutation"),
    ],
)
def test_a_value_that_means_nothing_is_refused(
    tmp_path: Path, grasps: Grasps, name: str, change: Any, said: str
):
    wrong = named_tensors(grasps) | {name: change(named_tensors(grasps)[name])}
    with pytest.raises(ModelFileError, match=said):
        load_grasps(write(tmp_path / "g.safetensors", wrong, header(grasps)))


@pytest.mark.parametrize(
    "meta", ["null", "[]", "5", '"x"', "", "[1,2", "[" * 100_000, "1" * 5000, "NaN", "{}"]
)
def test_metadata_that_is_no_object_is_refused(tmp_path: Path, grasps: Grasps, meta: str):
    with pytest.raises(ModelFileError):
        load_grasps(write(tmp_path / "g.safetensors", named_tensors(grasps), meta))


@pytest.mark.parametrize("value", [5, None, ["a"], {"a": [1] * 5}, float("nan"), 10**400])
def test_metadata_that_is_no_text_is_refused(tmp_path: Path, grasps: Grasps, value: Any):
    path = write(tmp_path / "g.safetensors", named_tensors(grasps), header(grasps, hand=value))
    with pytest.raises(ModelFileError, match="texts"):
        load_grasps(path)
    deep = json.dumps(header(grasps))[:-1] + ', "x": ' + "[" * 900 + "]" * 900 + "}"
    with pytest.raises(ModelFileError):
        load_grasps(write(path, named_tensors(grasps), deep))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no named pipes among its files")
def test_a_path_that_is_no_file_is_refused(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.safetensors")
    for path in (tmp_path / "pipe.safetensors", tmp_path):
        with pytest.raises(ModelFileError, match="no file"):
            load_grasps(path)


@pytest.mark.parametrize("name", ["a" * 5000, "a\0b"])
def test_a_path_that_no_file_can_have_is_refused_by_every_reader(name: str):
    for read, suffix in (
        (read_cloud, ".ply"),
        (read_mesh, ".stl"),
        (read_scene, ".npz"),
        (load_grasps, ""),
    ):
        with pytest.raises(BadArgument, match="expected "):
            read(name + suffix)


@pytest.mark.parametrize("format", ["json", "mujoco", "moveit", "ros2"])
def test_what_is_read_can_be_exported_or_is_refused(
    tmp_path: Path, grasps: Grasps, format: str, capsys: Any
):
    good = named_tensors(grasps)
    changes = {
        "joints": good["joints"] + 100,
        "joints too": good["joints"] * 1e300,
        "contacts.points": good["contacts.points"] * 1e300,
        "contacts.normals": 0 * good["contacts.normals"],
        "score": good["score"] * 1e300,
    }
    for name, tensor in changes.items():
        path = write(tmp_path / "g.safetensors", good | {name.split()[0]: tensor}, header(grasps))
        code = cli.main(["export", str(path), "--out", str(tmp_path / "out"), "--format", format])
        told = capsys.readouterr().err
        assert (code in (0, 1) and not told) or (code == 2 and ", got " in told), (name, told)
    fewer = good | {name: good[name][:, :3] for name in ("joints", "pregrasp")}
    path = write(tmp_path / "g.safetensors", fewer, header(grasps))
    assert cli.main(["export", str(path), "--out", str(tmp_path / "out"), "--format", format]) == 2
