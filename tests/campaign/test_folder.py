"""The folder of a campaign: every job is accounted for, and the bytes are those of an undisturbed
run.
"""

import hashlib
import json
import os
import random
import signal
import threading
import time
from pathlib import Path

import pytest
import torch

from tests.campaign.cheap import (
    ASKED,
    campaign,
    cheap_job,
    contents,
    die_at,
    records,
    wait_at,
    work_on,
)
from torchgrasp.campaign.folder import carry_out
from torchgrasp.data import read_shards
from torchgrasp.files import hold_folder
from torchgrasp.foundation.base import named_tensors
from torchgrasp.foundation.errors import ModelFileError, OutputError, Status

JOBS = 21


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    asked = campaign(JOBS)
    carry_out(asked, folder, work_on(asked, 0))
    return folder


def test_every_job_has_a_row_and_the_card_tells_the_truth(whole: Path):
    assert sorted(contents(whole)) == ["README.md", "campaign.json", "card.json"] + [
        f"shard-{k:06}.safetensors" for k in range(3)
    ]
    data = read_shards(whole)
    card = json.loads((whole / "card.json").read_text())
    assert [(row.object, row.view) for row in data.jobs] == [
        (r.object, r.view) for r in campaign(JOBS).rows
    ]
    assert data.jobs[2].status is Status.BAD_OBJECT and data.jobs[2].note == "no mesh"
    expected = [j % 4 if j != 2 else 0 for j in range(JOBS)]
    assert [row.grasps for row in data.jobs] == expected and len(data) == sum(expected) == card[
        "counts"
    ]["grasps"]
    assert (
        sum(card["counts"]["status"].values()) == JOBS
        and card["counts"]["status"]["BAD_OBJECT"] == 1
    )
    shards = sorted(whole.glob("shard-*"))
    assert card["shards_sha256"] == [hashlib.sha256(x.read_bytes()).hexdigest() for x in shards]
    assert card["campaign"] == hashlib.sha256((whole / "campaign.json").read_bytes()).hexdigest()
    passed = sum(int(data.job(j).passed.sum()) for j in range(JOBS))
    assert passed == card["counts"]["passed"] and card["counts"]["tries"] == 2 * len(data)
    text = (whole / "README.md").read_text()
    assert (
        text.startswith("---\nlicense: cc0-1.0\n")
        and f"{JOBS} jobs" in text
        and "| bad_object | 1 |" in text
    )


def test_items_do_not_depend_on_the_default_device(whole: Path):
    for points in (None, 3, 40):
        data = read_shards(whole, points)
        truth = [data[i] for i in range(3)]
        with torch.device("meta"):  # stands for a GPU
            found = [data[i] for i in range(3)]
            rows = list(data.job(5).grasps)
            assert len(data.job(3).grasps[[0, 2]]) == 2
        assert len(rows) == 1
        for one, other in zip(truth, found, strict=True):
            assert one.keys() == other.keys()
            assert all(torch.equal(one[name], other[name]) for name in one)


def test_changes_in_place_of_what_was_read_do_not_reach_later_reads(whole: Path):
    """A loader that adds noise in place, or turns the frames, would add up over the epochs."""
    data = read_shards(whole)
    truth = read_shards(whole)
    job = data.job(5)
    assert job.cloud is not None
    for x in (job.cloud.points, job.passed, job.outcome, *named_tensors(job.grasps).values()):
        x.zero_()
    for i in range(3):
        for x in data[i].values():
            x.zero_()
        assert all(torch.equal(x, truth[i][name]) for name, x in data[i].items())
    assert data.job(5).grasps == truth.job(5).grasps
    assert data.job(5).cloud == truth.job(5).cloud
    assert torch.equal(data.job(5).passed, truth.job(5).passed)


def test_a_job_is_read_as_it_was_written(whole: Path):
    data = read_shards(whole)
    for j in (0, 7, 11, JOBS - 1):  # of every shard; the second is its shard's last
        rng = torch.Generator().manual_seed(j)
        truth = records(rng, 5 + j % 3, j % 4)
        found = data.job(j)
        assert torch.equal(found.grasps.joints, truth.grasps.joints) and found.row.meta == {
            "cloud_sha256": str(j)
        }
        assert found.cloud is not None and torch.equal(found.cloud.points, truth.points)
        assert torch.equal(found.cloud.viewpoint, truth.viewpoints[0]) and torch.equal(
            found.passed, truth.passed
        )
        assert torch.equal(found.grasps.certificate.witness, truth.grasps.certificate.witness)
    assert data.job(2).cloud is None and len(data.job(2).grasps) == 0
    with pytest.raises(IndexError):
        data.job(JOBS)


@pytest.mark.promise("F1")
def test_an_interruption_after_any_job_changes_no_byte(whole: Path, tmp_path: Path):
    asked = campaign(JOBS)
    for after in range(0, JOBS, 3):

        class Stop(Exception):
            pass

        def stop(row, seen=[], after=after):  # noqa: B006
            seen.append(row)
            if len(seen) == after:
                raise Stop

        folder = tmp_path / str(after)
        for _ in range(JOBS):
            try:
                carry_out(asked, folder, work_on(asked, 0), stop)
                break
            except Stop:
                with pytest.raises(ModelFileError, match=r"card\.json"):
                    read_shards(folder)
        assert contents(folder) == contents(whole)


@pytest.mark.slow
@pytest.mark.promise("F4")
def test_processes_killed_three_times_change_no_byte(whole: Path, tmp_path: Path):
    """Somebody kills workers while they are at work; every job is done all the same."""
    pytest.importorskip("pebble")
    asked = campaign(JOBS)
    marks = tmp_path / "marks"
    killed = []
    marks.mkdir()

    def kill() -> None:
        while len(killed) < 3:
            time.sleep(0.05)
            for mark in marks.iterdir():
                os.kill(int(mark.name), signal.SIGKILL)
                mark.unlink(missing_ok=True)
                killed.append(mark.name)
                break

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    carry_out(asked, tmp_path / "out", work_on(asked, 2, cheap_job, 0.1, str(marks)))
    assert len(killed) == 3 and contents(tmp_path / "out") == contents(whole)


def test_a_deadly_job_is_named_and_the_next_call_tries_it_again(
    whole: Path, tmp_path: Path, monkeypatch
):
    pytest.importorskip("pebble")
    monkeypatch.setattr(
        "torchgrasp.campaign.folder.ROUNDS", 1
    )  # a process takes two seconds to begin
    asked = campaign(JOBS)
    told = []
    data = carry_out(asked, tmp_path / "out", work_on(asked, 1, die_at, 9), told.append)
    assert [j for j, row in enumerate(data.jobs) if row.status is Status.WORKER_DIED] == [9]
    assert data.card["counts"]["status"]["WORKER_DIED"] == 1 and len(told) == JOBS
    again = []
    carry_out(asked, tmp_path / "out", work_on(asked, 0), again.append)
    assert len(again) == 1 and contents(tmp_path / "out") == contents(whole)


@pytest.mark.promise("F1")
def test_a_job_is_on_disk_as_soon_as_it_ended(whole: Path, tmp_path: Path):
    """The first job waits until another one is told, which is on disk by then."""
    pytest.importorskip("pebble")
    asked = campaign(JOBS)
    told = []

    def tell(row) -> None:
        told.append(row)
        if len(told) == 5:
            assert len(list((tmp_path / "out" / "parts").iterdir())) == 5
            (tmp_path / "go").touch()

    carry_out(asked, tmp_path / "out", work_on(asked, 2, wait_at, 0, str(tmp_path / "go")), tell)
    assert contents(tmp_path / "out") == contents(whole)
    assert [(row.object, row.view) for row in told].index(("thing000", "view0")) >= 5


def test_what_is_damaged_is_made_anew(whole: Path, tmp_path: Path):
    asked = campaign(JOBS)
    out = tmp_path / "out"
    carry_out(asked, out, work_on(asked, 0))
    shard = out / "shard-000001.safetensors"
    rng = random.Random(0)
    good = shard.read_bytes()
    for bad in (
        good[:-8],
        b"",
        (out / "shard-000000.safetensors").read_bytes(),
        rng.randbytes(500),
    ):
        shard.write_bytes(bad)
        data = read_shards(out)
        with pytest.raises(ModelFileError, match="shard-000001"):
            data.job(9)
        done = []
        carry_out(asked, out, work_on(asked, 0), done.append)
        assert 8 <= len(done) <= 8 and contents(out) == contents(whole)
    shard.unlink()
    with pytest.raises(ModelFileError, match="without 1 of its shards"):
        read_shards(out)


@pytest.mark.promise("F7")
def test_other_campaigns_files_and_runs_are_refused(whole: Path, tmp_path: Path):
    asked = campaign(JOBS)
    for other in (
        campaign(JOBS, 9),
        campaign(JOBS)._replace(asked=ASKED | {"jobs_in_shard": 8, "licence": "MIT"}),
    ):
        with pytest.raises(OutputError, match="other campaigns"):
            carry_out(other, whole, work_on(other, 0))
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match="other files"):
        carry_out(asked, tmp_path, work_on(asked, 0))
    with hold_folder(tmp_path / "held"), pytest.raises(OutputError, match="in use by process"):
        carry_out(asked, tmp_path / "held", work_on(asked, 0))


@pytest.mark.parametrize(
    "change",
    [
        {"jobs": 5},
        {"jobs": [1]},
        {"jobs_in_shard": 0},
        {"jobs_in_shard": "8"},
        {"campaign": None},
        {"campaign": "x"},
    ],
)
def test_a_damaged_card_is_refused(whole: Path, tmp_path: Path, change):
    for name, data in contents(whole).items():
        (tmp_path / name).write_bytes(data)
    card = json.loads((tmp_path / "card.json").read_text())
    (tmp_path / "card.json").write_text(json.dumps(card | change))
    with pytest.raises(ModelFileError):
        read_shards(tmp_path).job(0)
    row = card["jobs"][0]
    for key, value in (
        ("status", "FINE"),
        ("grasps", -1),
        ("grasps", 10**9),
        ("object", 3),
        ("points", None),
    ):
        bad = card | {"jobs": [row | {key: value}, *card["jobs"][1:]]}
        (tmp_path / "card.json").write_text(json.dumps(bad))
        with pytest.raises(ModelFileError, match=key):
            read_shards(tmp_path)
    (tmp_path / "card.json").write_text(
        json.dumps(card | {"jobs": [row | {"note": "other"}, *card["jobs"][1:]]})
    )
    with pytest.raises(ModelFileError, match="other jobs"):
        read_shards(tmp_path).job(0)
