"""Safetensors files: round trip, refusals, atomic writes."""

import dataclasses
import os
import resource
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from safetensors.torch import save_file

from torchgrasp import load_grasps
from torchgrasp.files import (
    LOCK,
    hold_file,
    hold_folder,
    load_tensors,
    read_bytes,
    save_tensors,
    sha256,
    write_file,
)
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import ModelFileError, OutputError
from torchgrasp.foundation.limits import TENSOR_FILE_BYTES
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.values.planning import Certificate, Contacts, Grasps


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_file_is_read_as_far_as_it_says_it_is(tmp_path):
    """The system's own files say that they are empty; /proc/kmsg is one, and a reader of it waits
    for ever.
    """
    (tmp_path / "a").write_bytes(b"12\n3")
    (tmp_path / "link").symlink_to("/proc/self/maps")
    assert read_bytes(tmp_path / "a") == b"12\n3"
    assert read_bytes(tmp_path / "link") == b""


def some_grasps(g: int = 2, h: int = 4, f: int = 3) -> Grasps:
    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    return Grasps(
        joints=rand(g, h),
        pregrasp=rand(g, h),
        approach=rand(g, 3),
        obj_from_hand=rigid(rotation_from_vector(rand(g, 3)), rand(g, 3)),
        contacts=Contacts(rand(g, f, 3), rand(g, f, 3), rand(g, f), rand(g, f)),
        permutation=torch.arange(f).repeat(g, 1),
        tip_error=rand(g, f),
        clearance=rand(g),
        normal_angle=rand(g, f),
        certificate=Certificate(
            rand(g), rand(g), rand(g), torch.ones(g, dtype=torch.bool), rand(g, 6)
        ),
        score=rand(g),
        status=torch.zeros(g, dtype=torch.int64),
        meta={"hand": "toy", "unit": "metre"},
    )


@pytest.mark.parametrize(("fingertips", "known"), [(3, True), (4, True), (5, True), (3, False)])
def test_grasps_survive_the_round_trip(tmp_path, fingertips, known):
    before = some_grasps(f=fingertips)
    if not known:
        contacts = Contacts(before.contacts.points, before.contacts.normals)
        before = dataclasses.replace(before, contacts=contacts)
    before.save(tmp_path / "deep" / "grasps.safetensors")
    after = load_grasps(tmp_path / "deep" / "grasps.safetensors")
    assert after.meta == before.meta
    one = named_tensors(after)
    other = named_tensors(before)
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)
    assert (after.contacts.variance is not None) == (after.contacts.std_m is not None) == known


def test_optional_tensors_may_be_absent_and_others_may_not(tmp_path):
    save_tensors(tmp_path / "some", "toy", {"a": torch.zeros(1), "b": torch.ones(1)}, {})
    assert set(load_tensors(tmp_path / "some", "toy", {"a"}, {"b", "c"})[0]) == {"a", "b"}
    for names, optional in (({"a"}, {"c"}), ({"a", "c"}, {"b"})):
        with pytest.raises(ModelFileError, match="tensors"):
            load_tensors(tmp_path / "some", "toy", names, optional)


def test_grasps_of_other_numbers_of_fingertips_or_of_several_are_refused(tmp_path):
    four = some_grasps(f=4)
    three = some_grasps(f=3)
    for wrong in (
        some_grasps(f=2),
        some_grasps(f=6),
        dataclasses.replace(four, contacts=three.contacts),
    ):
        save_tensors(tmp_path / "grasps", "grasps", named_tensors(wrong), {})
        with pytest.raises(ModelFileError, match=r"three to five|one size for each letter"):
            load_grasps(tmp_path / "grasps")


def test_the_same_grasps_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        some_grasps().save(tmp_path / name)
    assert sha256(tmp_path / "a") == sha256(tmp_path / "b")


def test_every_truncation_is_refused(tmp_path):
    path = tmp_path / "grasps.safetensors"
    some_grasps().save(path)
    data = path.read_bytes()
    for n in [*range(0, 200, 7), *range(200, len(data), 131)]:
        path.write_bytes(data[:n])
        with pytest.raises(ModelFileError):
            load_grasps(path)


def test_foreign_files_are_refused(tmp_path):
    cases = {
        "wrong kind": ({"a": torch.zeros(1)}, '{"kind": "mixture", "version": "1"}'),
        "version": ({"a": torch.zeros(1)}, '{"kind": "toy", "version": "99"}'),
        "other tensors": ({"b": torch.zeros(1)}, '{"kind": "toy", "version": "1"}'),
        "nan": ({"a": torch.tensor([float("nan")])}, '{"kind": "toy", "version": "1"}'),
        "overflow": ({"a": torch.tensor([-1e31])}, '{"kind": "toy", "version": "1"}'),
        "no object": ({"a": torch.zeros(1)}, "[1]"),
        "no json": ({"a": torch.zeros(1)}, "{"),
        "no metadata": ({"a": torch.zeros(1)}, None),
    }
    for name, (tensors, meta) in cases.items():
        save_file(tensors, tmp_path / name, metadata=None if meta is None else {"torchgrasp": meta})
        with pytest.raises(ModelFileError):
            load_tensors(tmp_path / name, "toy", {"a"})
    for name in ("missing", "."):
        with pytest.raises(ModelFileError):
            load_tensors(tmp_path / name, "toy", {"a"})


@pytest.mark.promise("F3")
def test_a_failed_write_leaves_the_old_file_and_no_debris(tmp_path):
    path = save_tensors(tmp_path / "f", "toy", {"a": torch.zeros(1)}, {})
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OutputError, match="File too large"):
            write_file(path, bytes(5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["f"]


def test_a_file_may_be_written_by_a_function(tmp_path):
    write_file(tmp_path / "f", lambda file: file.write(b"some") + file.write(b" bytes"))
    assert (tmp_path / "f").read_bytes() == b"some bytes"


def test_a_held_folder_or_file_loses_what_a_killed_run_left_half_written(tmp_path):
    parts = [
        tmp_path / ".f.dead.part",
        tmp_path / ".g.dead.part",
        tmp_path / "deep" / ".h.dead.part",
    ]
    (tmp_path / "deep").mkdir()
    for path in parts:
        path.write_bytes(b"half")
    with hold_file(tmp_path / "f"):
        assert [path.exists() for path in parts] == [False, True, True]
    with hold_folder(tmp_path):
        assert not any(path.exists() for path in parts)


def test_many_writers_of_one_file_leave_one_of_theirs_whole(tmp_path):
    contents = [bytes([k]) * 100_000 for k in range(40)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda content: write_file(tmp_path / "f", content), contents))
    assert (tmp_path / "f").read_bytes() in contents and os.listdir(tmp_path) == ["f"]


def test_a_file_is_held_by_one_run_and_its_folder_left_as_it_was(tmp_path):
    path = tmp_path / "new" / "model.safetensors"
    with hold_file(path), hold_file(path.with_name("other")):
        with (
            pytest.raises(
                OutputError, match=r"path: expected .*got .*model\.safetensors, in use by"
            ),
            hold_file(path),
        ):
            pytest.fail("held twice")
    assert os.listdir(tmp_path) == []


def test_a_file_of_no_reasonable_size_is_refused_unread(tmp_path):
    with save_tensors(tmp_path / "f", "toy", {"a": torch.zeros(1)}, {}).open("ab") as file:
        file.truncate(3 * TENSOR_FILE_BYTES)
    with pytest.raises(ModelFileError, match="at most"):
        load_tensors(tmp_path / "f", "toy", {"a"})


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="writable folder"):
        write_file(tmp_path / "file" / "x", "")


@pytest.mark.promise("F7")
def test_a_folder_is_held_by_one_run_and_left_as_it_was(tmp_path):
    with hold_folder(tmp_path / "new" / "deep"):
        refused = rf"folder: expected .*got .*deep, in use by process {os.getpid()} on"
        with pytest.raises(OutputError, match=refused), hold_folder(tmp_path / "new" / "deep"):
            pytest.fail("held twice")
    assert os.listdir(tmp_path) == []
    with hold_folder(tmp_path / "new"):
        (tmp_path / "new" / "result").write_text("kept")
    assert os.listdir(tmp_path / "new") == ["result"]
    with hold_folder(tmp_path / "new"):
        assert sorted(os.listdir(tmp_path / "new")) == [LOCK, "result"]
    (tmp_path / "file").write_text("x")
    with (
        pytest.raises(OutputError, match="folder that can be written"),
        hold_folder(tmp_path / "file" / "x"),
    ):
        pytest.fail("no folder")
