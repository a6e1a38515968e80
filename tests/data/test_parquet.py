"""A data set as Parquet: other libraries read offline what our own reader reads."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.campaign.cheap import campaign, contents, work_on
from tests.data.others import ROOT, read_foreign
from tests.make import load_hand
from torchgrasp.app import cli
from torchgrasp.campaign.folder import carry_out
from torchgrasp.data import GraspShards, read_shards, write_parquet
from torchgrasp.foundation.errors import (
    BadArgument,
    MissingExtra,
    ModelFileError,
    OutputError,
    Status,
)
from torchgrasp.geometry.frames import apply

parquet = pytest.importorskip("pyarrow.parquet")
JOBS = 21
SAMPLE = ROOT / "examples" / "sample"


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> GraspShards:
    """Three shards; the first has jobs without grasps, and one without a cloud."""
    folder = tmp_path_factory.mktemp("shards")
    asked = campaign(JOBS)
    carry_out(asked, folder, work_on(asked, 0))
    return read_shards(folder)


@pytest.fixture(scope="module")
def written(shards: GraspShards, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_parquet(shards, tmp_path_factory.mktemp("parquet") / "data")


@pytest.fixture(scope="module")
def foreign(written: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """What Hugging Face and Croissant read offline, in the written folder and in the sample."""
    return read_foreign("tables", [written, SAMPLE], tmp_path_factory.mktemp("foreign"))


def rows(folder: Path, name: str) -> dict[str, list[Any]]:
    return parquet.read_table(folder / name).to_pydict()


def check_rows(shards: GraspShards, found: dict[str, list[Any]]) -> None:
    """Compare rows of grasps with the items of the reader, number by number."""
    assert found["grasp"] == list(range(len(shards)))
    for i, item in enumerate(shards):
        row = shards.jobs[int(item["job"])]
        assert [found[name][i] for name in ("object", "view", "family", "group")] == [
            *row[:2],
            row.family,
            row.group,
        ]
        for name in set(item) - {"points", "viewpoint"}:
            np.testing.assert_array_equal(
                np.array(found[name][i], item[name].numpy().dtype), item[name].numpy()
            )
    tried = [
        [Status(x).name for x in grasp]
        for j in range(JOBS)
        for grasp in shards.job(j).outcome.tolist()
    ]
    assert (
        found["outcomes"] == tried and set(found["friction"]) == {0.5} and set(found["seed"]) == {0}
    )


def check_views(shards: GraspShards, found: dict[str, list[Any]]) -> None:
    """Compare rows of views with the jobs of the reader."""
    assert (
        found["job"] == list(range(JOBS))
        and found["status"][2] == "BAD_OBJECT"
        and found["note"][2] == "no mesh"
    )
    for j in range(JOBS):
        row, cloud, *_ = shards.job(j)
        assert [found[x][j] for x in ("object", "grasps", "passed")] == [
            row.object,
            row.grasps,
            row.passed,
        ]
        if cloud is None:
            assert found["points"][j] == [] and found["viewpoint"][j] is None
        else:
            np.testing.assert_array_equal(
                np.float32(found["points"][j]), cloud.points.float().numpy()
            )
            np.testing.assert_array_equal(
                np.float32(found["viewpoint"][j]), cloud.viewpoint.float().numpy()
            )


def test_arrow_reads_what_the_reader_reads(shards: GraspShards, written: Path):
    check_rows(shards, rows(written, "grasps"))
    check_views(shards, rows(written, "views"))
    meta = parquet.read_schema(written / "grasps" / "shard-000001.parquet").metadata
    assert json.loads(meta[b"torchgrasp"])["joint_names"] == "a, b, c, d"


def test_hugging_face_and_croissant_read_it_offline(
    shards: GraspShards, foreign: list[dict[str, Any]]
):
    found = foreign[0]
    check_rows(shards, found["grasps.rows"])
    check_views(shards, found["views.rows"])
    types = found["grasps.types"]
    assert (
        types["joints"] == "List(Value('float32'), length=4)" and types["closed"] == "Value('bool')"
    )
    assert types["contacts"] == "List(List(Value('float32'), length=3), length=3)"
    assert found["errors"] == [] and found["name"].startswith("grasps-toy-")
    check_rows(shards, found["grasps.records"])
    check_views(shards, found["views.records"])


def test_the_shipped_sample_loads_in_one_line(foreign: list[dict[str, Any]]):
    """A thousand grasps in at most 5 MB, tried in simulation; their numbers fit the hand and each
    other.
    """
    assert sum(x.stat().st_size for x in SAMPLE.rglob("*") if x.is_file()) <= 5e6
    found = foreign[1]
    grasps = found["grasps.rows"]
    assert len(grasps["grasp"]) == 1000 and grasps == found["grasps.records"]
    passed = [tries == ["OK"] for tries in grasps["outcomes"]]
    assert passed == [share == 1.0 for share in grasps["simulated"]] and sum(
        found["views.rows"]["passed"]
    ) == sum(passed)
    assert 0.5 < np.mean(passed) < 1.0, "verdicts of both kinds"
    hand = load_hand("allegro")
    asked = json.loads((SAMPLE / "source.json").read_text())["asked"]["hand"]
    assert (
        asked["joint_names"] == ", ".join(hand.joint_names)
        and asked["sha256"] == hand.source.sha256
    )
    columns = ("joints", "obj_from_hand", "contacts")
    joints, poses, contacts = (torch.tensor(grasps[name], dtype=torch.float64) for name in columns)
    gap = (apply(poses, hand.tip_centres(joints)) - contacts).norm(
        dim=-1
    ) - hand.tip_radius.double()
    assert float(gap.abs().max()) < 1e-3, (
        "fingertips touch their contacts [m]: joints have the hand's order"
    )


def test_an_export_that_was_broken_off_goes_on_and_others_are_refused(
    shards: GraspShards, written: Path, tmp_path: Path
):
    again = tmp_path / "again"
    write_parquet(shards, again)
    for name in ("README.md", "croissant.json", "grasps/shard-000002.parquet"):
        (again / name).unlink()
    write_parquet(shards, again)
    assert contents(again) == contents(written)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match="other files"):
        write_parquet(shards, tmp_path / "mine")


def test_no_grasps_other_cards_and_no_pyarrow_are_told(
    tmp_path: Path, shards: GraspShards, monkeypatch: pytest.MonkeyPatch
):
    asked = campaign(1)
    carry_out(asked, tmp_path / "none", work_on(asked, 0))
    with pytest.raises(BadArgument, match="without a grasp"):
        write_parquet(read_shards(tmp_path / "none"), tmp_path / "out")
    for change in (
        {"asked": {}},
        {"asked": 3},
        {"counts": {}},
        {"counts": {"status": {"FINE": 1}}},
    ):
        with pytest.raises(ModelFileError, match=r"card\.json"):
            write_parquet(dataclasses.replace(shards, card=shards.card | change), tmp_path / "out")
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingExtra, match=r"torchgrasp\[data\]"):
        write_parquet(shards, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_campaign_whose_parquet_cannot_be_written_ends_before_its_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("torchgrasp.app.cli.evaluate.import_simulator", lambda _: None)
    words = [
        "campaign",
        str(tmp_path),
        "--hand",
        "barrett",
        "--out",
        str(tmp_path / "out"),
        "--parquet",
        str(tmp_path),
    ]
    (tmp_path / ".source.json.abc.part").touch()  # of a run that was killed, which may go on
    assert cli.main(words) == 2 and "--parquet" not in capsys.readouterr().err
    (tmp_path / "thesis.tex").write_text("years of work")
    assert cli.main(words) == 2 and "--parquet: expected an empty folder" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    assert (
        cli.main(words) == 2
        and "torchgrasp[data]" in capsys.readouterr().err
        and not (tmp_path / "out").exists()
    )
