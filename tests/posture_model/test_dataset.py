"""Samples on disk: the same bytes for any number of workers and after a kill; faults of the disk;
damaged folders.
"""

import json
import os
import resource
import signal
import threading
import time
from pathlib import Path

import pytest
import torch

from torchgrasp import load_hand, sample_configurations
from torchgrasp.app.cli import main
from torchgrasp.files import hold_folder
from torchgrasp.foundation.errors import BadArgument, ModelFileError, OutputError
from torchgrasp.posture_model import SampleSpec, dataset, load_samples, write_samples


@pytest.fixture
def small(monkeypatch):
    """Chunks of 500 postures: several of them in little time."""
    monkeypatch.setattr("torchgrasp.posture_model.sample.CHUNK_POSTURES", 500)
    monkeypatch.setattr("torchgrasp.posture_model.dataset.CHUNK_POSTURES", 500)
    monkeypatch.setattr("torchgrasp.posture_model.sample.BLOCK_POSTURES", 250)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("sampling", ["uniform", "grasping"])
def test_a_folder_holds_what_sample_configurations_returns_for_any_number_of_workers(
    tmp_path, small, sampling
):
    hand = load_hand("barrett")
    spec = SampleSpec(1700, 3, sampling)
    written = write_samples(hand, spec, tmp_path / "one")
    write_samples(hand, spec, tmp_path / "three", workers=3)
    assert contents(tmp_path / "one") == contents(tmp_path / "three")
    assert len(contents(tmp_path / "one")) == 5
    result = load_samples(tmp_path / "one")
    truth = sample_configurations(hand, 1700, seed=3, sampling=sampling)
    assert result == written
    assert len(result) == 1700
    assert [len(chunk) for chunk in result] == [500, 500, 500, 200]
    everything = result.read()
    assert torch.equal(everything.joints, truth.joints)
    assert torch.equal(everything.q, truth.q)
    assert everything.meta == truth.meta
    assert everything.joint_names == truth.joint_names
    assert torch.equal(result.read(600).joints, truth.joints[:600])
    with pytest.raises(BadArgument, match=r"n: expected .*got 1701"):
        result.read(1701)


def test_a_folder_serves_a_loader_posture_by_posture(tmp_path, small):
    write_samples(load_hand("barrett"), SampleSpec(1100), tmp_path)
    samples = load_samples(tmp_path)
    whole = load_samples(tmp_path).read()
    drawn = torch.Generator().manual_seed(0)
    batches = list(
        torch.utils.data.DataLoader(samples, batch_size=64, shuffle=True, generator=drawn)
    )
    joints, codes = (torch.cat(parts) for parts in zip(*batches, strict=True))
    order = torch.cat([joints, codes], 1)[:, 0].argsort()
    assert torch.equal(
        joints[order], whole.joints[whole.joints[:, 0].argsort()]
    ) and codes.shape == (1100, 6)
    assert torch.equal(samples[-1][1], whole.q[1099])
    for x in samples[7]:
        x.add_(1.0)  # noise in place must not add up over the epochs
    assert torch.equal(samples[7][0], whole.joints[7]) and torch.equal(samples[7][1], whole.q[7])
    with pytest.raises(IndexError):
        samples[1100]
    with pytest.raises(TypeError):
        samples["joints"]


def start_held(arguments: list[str], held: int) -> int:
    """Return the number of a child that runs a command and waits before a chunk of number `held`."""
    if child := os.fork():
        return child
    interrupted = threading.Event()

    def interrupt(*_: object) -> None:
        interrupted.set()
        raise KeyboardInterrupt

    def draw_the_first(hand, spec, i, draw=dataset.draw_chunk):
        if i >= held:  # the run cannot end before it is interrupted, whatever the machine does
            interrupted.wait()
        return draw(hand, spec, i)

    code = 70  # of a command that raises
    try:
        signal.signal(signal.SIGINT, interrupt)
        dataset.draw_chunk = draw_the_first
        code = main(arguments)
    finally:
        os._exit(code)


@pytest.mark.promise("F1")
def test_a_run_that_was_interrupted_and_killed_is_continued_to_the_same_bytes(tmp_path, small):
    hand = load_hand("barrett")
    n = 3500
    folder = tmp_path / "killed"
    arguments = [
        "hand",
        "sample",
        "--hand",
        "barrett",
        "--n",
        str(n),
        "--out",
        str(folder),
        "--workers",
        "2",
    ]
    for sign, expected, held in ((signal.SIGINT, 130, 2), (signal.SIGKILL, -signal.SIGKILL, 5)):
        before = {path: path.stat().st_mtime_ns for path in folder.glob("chunk-*")}
        run = start_held(arguments, held)
        while len(list(folder.glob("chunk-*"))) < held:
            assert os.waitpid(run, os.WNOHANG) == (0, 0)
            time.sleep(0.01)
        os.kill(run, sign)
        assert os.waitstatus_to_exitcode(os.waitpid(run, 0)[1]) == expected
        assert len(before) < held <= len(list(folder.glob("chunk-*"))) < 7
        assert all(
            path.stat().st_mtime_ns == then for path, then in before.items()
        )  # whole chunks were kept
    with pytest.raises(ModelFileError, match="without"):
        load_samples(folder)
    write_samples(hand, SampleSpec(n), folder)
    write_samples(hand, SampleSpec(n), tmp_path / "whole", workers=3)
    assert contents(folder) == contents(tmp_path / "whole")


@pytest.mark.promise("F1")
def test_half_a_chunk_is_never_taken_for_a_whole_one(tmp_path, small):
    hand = load_hand("barrett")
    write_samples(hand, SampleSpec(1100), tmp_path)
    whole = contents(tmp_path)
    chunk = tmp_path / "chunk-000001.safetensors"
    for damaged in (
        whole[chunk.name][:-8],
        b"",
        whole["chunk-000000.safetensors"],
        whole["chunk-000002.safetensors"],
    ):
        chunk.write_bytes(damaged)
        with pytest.raises(ModelFileError, match="chunk-000001"):
            load_samples(tmp_path).read()
        (tmp_path / ".chunk-000001.safetensors.abc.part").write_bytes(
            damaged
        )  # of a run that was killed
        write_samples(hand, SampleSpec(1100), tmp_path)
        assert contents(tmp_path) == whole


@pytest.mark.promise("F3")
def test_a_full_disk_leaves_nothing_half_written_and_the_run_goes_on_later(
    tmp_path, small, monkeypatch
):
    hand = load_hand("barrett")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OutputError, match=r"chunk-00000\d.safetensors \(File too large\)"):
            write_samples(hand, SampleSpec(1100), tmp_path / "small", workers=2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in (tmp_path / "small").iterdir()] == ["samples.json"]
    write_samples(hand, SampleSpec(1100), tmp_path / "small")
    write_samples(hand, SampleSpec(1100), tmp_path / "whole")
    assert contents(tmp_path / "small") == contents(tmp_path / "whole")
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1000})())
    with pytest.raises(OutputError, match=r"expected 88000 bytes.*1000 bytes free"):
        write_samples(hand, SampleSpec(1100), tmp_path / "full")


@pytest.mark.parametrize(
    "half", [".samples.json.abc123.part", ".chunk-000000.safetensors.abc123.part"]
)
def test_a_run_killed_between_a_temporary_file_and_its_name_is_continued(tmp_path, small, half):
    (tmp_path / half).write_text("{")
    write_samples(load_hand("barrett"), SampleSpec(600), tmp_path)
    assert sorted(x.name for x in tmp_path.iterdir()) == [
        "chunk-000000.safetensors",
        "chunk-000001.safetensors",
        "samples.json",
    ]


@pytest.mark.parametrize("sampling", ["uniform", "grasping"])
def test_a_hand_of_four_fingers_is_refused_before_a_folder_is_made(tmp_path, sampling):
    with pytest.raises(BadArgument, match="three fingertips"):
        write_samples(load_hand("allegro", 4), SampleSpec(100, 0, sampling), tmp_path / "four")
    assert not (tmp_path / "four").exists()


@pytest.mark.promise("F7")
def test_a_folder_in_use_or_of_other_samples_or_files_is_refused(tmp_path, small):
    hand = load_hand("barrett")
    write_samples(hand, SampleSpec(600), tmp_path / "a")
    for other in (SampleSpec(601), SampleSpec(600, 1), SampleSpec(600, 0, "grasping")):
        with pytest.raises(OutputError, match="holds other samples"):
            write_samples(hand, other, tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match="holds other files"):
        write_samples(hand, SampleSpec(600), tmp_path / "b")
    assert [path.name for path in (tmp_path / "b").iterdir()] == ["thesis.tex"]
    with pytest.raises(OutputError, match="a folder that can be written"):
        write_samples(hand, SampleSpec(600), tmp_path / "b" / "thesis.tex")
    with pytest.raises((BadArgument, TypeError), match="sampling"):
        SampleSpec(600, 0, "thumbs")  # pyright: ignore[reportArgumentType]
    with pytest.raises(BadArgument, match=r"workers: expected .*got 0"):
        write_samples(hand, SampleSpec(600), tmp_path / "a", workers=0)
    held = tmp_path / "c"
    with hold_folder(held), pytest.raises(OutputError, match=f"in use by process {os.getpid()} on"):
        write_samples(hand, SampleSpec(100), held)
    held.mkdir(exist_ok=True)
    (held / ".lock").write_text(
        "process 1 on nowhere"
    )  # left by a run that was killed: nobody holds it
    write_samples(hand, SampleSpec(100), held)
    assert not (held / ".lock").exists()


def test_a_damaged_manifest_and_what_is_none_are_refused(tmp_path, small):
    write_samples(load_hand("barrett"), SampleSpec(600), tmp_path)
    path = tmp_path / "samples.json"
    good = json.loads(path.read_text())
    for change in (
        {"n": 0},
        {"n": True},
        {"n": 10**12},
        {"n": "600"},
        {"joint_names": []},
        {"joint_names": "abcd"},
        {"seed": 0},
        {"chunk": 7},
        {"version": 2},
        {"torchgrasp": "grasps"},
        {"joint_names": ["a"]},
        {"hand": "allegro"},
    ):
        path.write_text(json.dumps(good | change))
        with pytest.raises(ModelFileError):
            load_samples(tmp_path).read()
    for data in (b"", b"{", b"[]", b"\xff\xfe", b"[" * 100_000, b" " * 2_000_000):
        path.write_bytes(data)
        with pytest.raises(ModelFileError, match=r"samples\.json"):
            load_samples(tmp_path)
    with pytest.raises(ModelFileError, match=r"samples\.json, which is no file"):
        load_samples(tmp_path / "nowhere")


def test_command(tmp_path, small, capsys):
    arguments = ["hand", "sample", "--hand", "barrett", "--n", "700", "--sampling", "grasping"]
    assert main([*arguments, "--out", str(tmp_path / "a")]) == 0
    assert "700 grasping postures of barrett" in capsys.readouterr().out
    assert len(load_samples(tmp_path / "a")) == 700
    for wrong, named in [
        (["--hand", "fist"], "--hand"),
        (["--n", "0"], "--n"),
        (["--seed", "-1"], "--seed"),
        (["--fingers", "toes"], "--fingers"),
        (["--seed", "1"], "--out"),
    ]:
        assert main([*arguments, "--out", str(tmp_path / "a"), *wrong]) == 2
        assert f"torchgrasp: {named}" in capsys.readouterr().err
