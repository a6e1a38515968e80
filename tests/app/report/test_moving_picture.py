"""Films of a closing: what is seen rises as in the record, and lasts as long."""

import dataclasses
import functools
import itertools
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from tests.make import ROOT
from tests.pinch import QUICK
from torchgrasp import TrialSpec
from torchgrasp.app.report.canvas import OBJECT, rgb
from torchgrasp.app.report.moving_picture import MOVIE, write_film
from torchgrasp.data.shipped import DATA, load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument, MissingExtra


def rows_of(picture):
    """Rows of the pixels that have the hue of the object."""
    pixels = np.asarray(picture.convert("RGB"), float)
    wanted = np.array(rgb(OBJECT)) / np.linalg.norm(rgb(OBJECT))
    length = np.linalg.norm(pixels, axis=-1)
    near = (pixels @ wanted > 0.9995 * length) & (length > 60)
    rows, columns = near.nonzero()
    # edges of the hand may have the hue, too
    return rows[np.abs(columns - np.median(columns)) < 40]


def film(run, path, **options):
    write_film(path, run.hand, run.executable[0], run.closure, run.mesh, **options)
    return path


def test_a_gif_shows_the_rise_and_lasts_as_long_as_the_closing(run, tmp_path):
    told = []
    # the hand rises beside the ball, and hides nothing of it
    beside = run.closure.hand_pose.clone()
    beside[:, 1, 3] += 0.3
    run = dataclasses.replace(run, closure=dataclasses.replace(run.closure, hand_pose=beside))
    watch = {"observer": lambda *x: told.append(x), "direction": (1.0, 0.0, 0.3)}
    path = film(run, tmp_path / "x.gif", rate=4, **watch)
    with Image.open(path) as image:
        pictures = [frame.copy() for frame in ImageSequence.Iterator(image)]
        times = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
        assert image.info["loop"] == 0 and image.size == MOVIE.size
    # a second in steps of 250 ms, each picture for its step
    assert times == [250] * 5 and told[-1] == (5, 5)
    rows = [rows_of(picture) for picture in pictures]
    assert min(map(len, rows)) > 500
    means = [part.mean() for part in rows]
    assert all(after < before for before, after in itertools.pairwise(means))
    # a ball of 60 mm rises by 100 mm, which a camera from above sees a little shorter
    assert means[0] - means[-1] == pytest.approx(np.ptp(rows[0]) * 100 / 60, rel=0.2)


def test_a_closing_that_diverged_ends_with_its_last_known_state(run, tmp_path):
    pose = run.closure.object_pose.clone()
    pose[3:] = torch.nan
    lost = dataclasses.replace(
        run, closure=dataclasses.replace(run.closure, object_pose=pose, held=False)
    )
    with Image.open(film(lost, tmp_path / "x.gif", rate=4)) as image:
        assert 2 <= image.n_frames <= 4


def test_an_mp4_shows_what_the_gif_shows(run, tmp_path, monkeypatch):
    python = ROOT / ".beside" / "film" / "bin" / "python"
    if not python.exists():
        pytest.skip("scripts/beside makes .beside/film")
    words = [str(python), "-c", "import imageio_ffmpeg as f; print(f.get_ffmpeg_exe())"]
    found = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "ffmpeg").symlink_to(found)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    path = film(run, tmp_path / "x.mp4", rate=4)
    decode = ["-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run([found, *decode], capture_output=True, check=True).stdout
    width, height = MOVIE.size
    seen = np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)
    assert len(seen) == 5
    with Image.open(film(run, tmp_path / "x.gif", rate=4)) as image:
        for moving, still in zip(seen, ImageSequence.Iterator(image), strict=False):
            other = np.asarray(still.convert("RGB"), float)
            assert np.abs(moving - other).mean() < 6
    before = path.read_bytes()
    assert film(run, path, rate=4).read_bytes() == before


def test_an_mp4_without_an_encoder_names_the_extra(run, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra, match=r"torchgrasp\[film\]"):
        film(run, tmp_path / "x.mp4")
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_film_is_refused(run, tmp_path):
    with pytest.raises(BadArgument, match=r"path: .*\.gif or \.mp4"):
        film(run, tmp_path / "x.avi")
    slow = dataclasses.replace(run.closure, time=100 * run.closure.time)
    with pytest.raises(BadArgument, match=r"closure: .*60 s, got 100 s"):
        film(dataclasses.replace(run, closure=slow), tmp_path / "x.gif")
    with pytest.raises(BadArgument, match="rate"):
        film(run, tmp_path / "x.gif", rate=0)


@pytest.mark.sim
def test_the_command_closes_the_hand_and_writes_a_gif(run_command, tmp_path, monkeypatch):
    quick = functools.partial(TrialSpec, hold_time=QUICK.hold_time, control_rate=QUICK.control_rate)
    monkeypatch.setattr("torchgrasp.app.cli.filming.TrialSpec", quick)
    load_shipped_grasp("jug", "barrett").save(tmp_path / "grasps.safetensors")
    out = tmp_path / "lift.gif"
    mesh = DATA / "jug" / "mesh.ply"
    words = ["film", tmp_path, "--mesh", mesh, "--out", out, "--rate", "2"]
    code, said, _ = run_command(*words)
    assert code == 0 and "the object held" in said and str(out) in said
    with Image.open(out) as image:
        pictures = [frame.copy() for frame in ImageSequence.Iterator(image)]
    rows = [rows_of(picture).mean() for picture in pictures]
    assert rows[0] - rows[-1] > 20


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--out", "lift.avi"], "--out: expected a file ending in .gif or .mp4"),
        (["--out", "lift.gif"], "--mesh: expected a mesh where"),
        (
            ["--out", "lift.gif", "--rank", "7"],
            "--rank: expected at most 1, the number of executable",
        ),
        (["--out", "lift.gif", "--rate", "99"], "--rate: expected a whole number in [1, 50]"),
    ],
)
@pytest.mark.sim
def test_the_command_refuses_in_one_sentence(refusal, words, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    load_shipped_grasp("jug", "barrett").save(tmp_path / "grasps.safetensors")
    assert refusal("film", "grasps.safetensors", *words).startswith(told)
    assert [path.name for path in tmp_path.iterdir()] == ["grasps.safetensors"]
