"""A campaign on a real object: what is written is what `evaluate` finds, and what others compute of
it.
"""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch

from tests.campaign.conftest import LIFT, QUICK
from torchgrasp import ContactSpec, Status, certify, load_hand
from torchgrasp.app import cli
from torchgrasp.campaign import CampaignSpec, run_campaign
from torchgrasp.campaign import job as job_module
from torchgrasp.data import GraspShards, read_shards, read_view
from torchgrasp.evaluation import PROTOCOLS, EvaluationSpec, evaluate
from torchgrasp.evaluation.views import ObjectView
from torchgrasp.foundation.errors import BadArgument, DatasetError, OutputError


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_the_records_are_what_evaluate_finds(data: Path, carton: Path):
    (score,) = evaluate(carton, load_hand("barrett"), LIFT, QUICK.trials)
    job = read_shards(data).job(0)
    assert job.row.executable == score.executable and job.row.status is Status.OK
    assert [Status(x) for x in job.outcome[:, 0].tolist()] == [a.status for a in score.attempts]
    assert job.passed[:, 0].tolist() == [a.passed for a in score.attempts]
    assert job.grasps.success.tolist() == [a.predicted for a in score.attempts]
    cloud = read_view(carton, "carton", "view0")
    assert torch.equal(job.cloud.points, cloud.points.double()) and torch.equal(
        job.cloud.viewpoint, cloud.viewpoint
    )


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_a_loader_makes_batches_of_what_the_job_holds(data: Path):
    data = read_shards(data, points=300)
    assert len(data) == 2
    (batch,) = torch.utils.data.DataLoader(data, batch_size=2)
    grasps = data.job(0).grasps
    assert batch["points"].shape == (2, 300, 3) and batch["points"].dtype == torch.float32
    assert torch.equal(batch["joints"], grasps.joints.float())
    assert torch.equal(batch["contacts"], grasps.contacts.points.float())
    again = certify(grasps.contacts, ContactSpec(friction=0.6))
    assert torch.allclose(batch["margin"].double(), again.margin, atol=1e-6)
    assert torch.equal(batch["closed"], again.closed)
    cloud = {tuple(p) for p in data.job(0).cloud.points.float().tolist()}
    assert all(tuple(p) in cloud for p in batch["points"][1].tolist())
    assert torch.equal(batch["points"][0], data[0]["points"])
    assert not torch.equal(batch["points"][0], batch["points"][1])
    assert dataclasses.replace(data, points=5000)[0]["points"].shape == (5000, 3)
    with pytest.raises(IndexError):
        data[2]


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_a_success_that_no_trial_supports_is_no_number_in_a_data_set(data: Path, monkeypatch):
    data = read_shards(data)
    predicted = [data[i]["predicted"] for i in range(2)]
    assert predicted == data.job(0).grasps.success.float().tolist()
    shard = data._read(0)
    known = torch.tensor([True, False])
    grasps = dataclasses.replace(shard.records.grasps, known=known)
    records = dataclasses.replace(shard.records, grasps=grasps)
    monkeypatch.setattr(GraspShards, "_read", lambda *_: shard._replace(records=records))
    changed = read_shards(data.folder)
    assert changed[0]["predicted"] == predicted[0] and changed[1]["predicted"].isnan()
    assert type(changed[0]["predicted"]) is torch.Tensor


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
def test_bad_objects_and_errors_of_the_library_have_rows(
    carton: Path, tmp_path: Path, monkeypatch, capsys
):
    pytest.importorskip("sapien")
    objects = tmp_path / "objects"
    shutil.copytree(carton, objects)
    entries = json.loads((objects / "manifest.json").read_text())["objects"]
    entries |= {
        "../up": entries["carton"],
        "gone": entries["carton"],
        "blind": {"views": {}},
        "loose": 5,
    }
    (objects / "manifest.json").write_text(json.dumps({"objects": entries}))
    monkeypatch.setitem(PROTOCOLS, "tabletop", LIFT)
    words = [
        "campaign",
        str(objects),
        "--hand",
        "barrett",
        "--out",
        str(tmp_path / "out"),
        "--starts",
        "12",
    ]
    words += ["--grasps", "1", "--workers", "0"]
    with monkeypatch.context() as faulty:
        faulty.setattr(job_module, "try_grasp", lambda *_: 1 / 0)
        assert cli.main(words) == 1
    said = capsys.readouterr().out
    assert said.endswith(
        "\n1 job failed by no fault of the object (broken): the same command tries again\n"
    )
    rows = {row.object: row for row in read_shards(tmp_path / "out").jobs}
    assert rows["carton"].status is Status.BROKEN and "ZeroDivisionError" in rows["carton"].note
    bad = {
        "'../up'": "a printable name",
        "gone": "no file",
        "blind": "no view",
        "'loose'": "object",
    }
    assert {name: rows[name].status for name in bad} == dict.fromkeys(bad, Status.BAD_OBJECT)
    assert [name for name, words in bad.items() if words not in rows[name].note] == []
    assert "5 jobs: 4 bad_object, 1 broken" in said and "0 grasps" in said
    assert not (tmp_path / "up").exists() and set(x.name for x in tmp_path.iterdir()) == {
        "objects",
        "out",
    }
    assert cli.main(words) == 0
    assert "5 jobs: 4 bad_object, 1 ok" in capsys.readouterr().out


def test_a_fault_of_the_machine_is_no_row_of_a_job(carton: Path, monkeypatch):
    """What an object's own files do wrong is refused by name, so an OSError is of the installation
    or the disk.
    """

    def fail(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(job_module, "plan_view", fail)
    view = ObjectView(carton, "carton", "view0", load_hand("barrett").source)
    meta = {"campaign": "x", "versions": json.dumps(job_module.versions())}
    with pytest.raises(OSError, match="no space left"):
        job_module.run_job(view, LIFT, EvaluationSpec(), meta)


def test_bad_arguments_are_named_before_any_work(carton: Path, tmp_path: Path, capsys):
    for trials in (
        EvaluationSpec(planned=True),
        EvaluationSpec(complete=True),
        EvaluationSpec(fingers="auto"),
    ):
        with pytest.raises(BadArgument, match=r"trials: expected .*got"):
            CampaignSpec(trials=trials)
    for licence in ("", "a\nb", "x" * 101):
        with pytest.raises(BadArgument, match=r"licence: expected .*got"):
            CampaignSpec(licence=licence)
    with pytest.raises(DatasetError, match=r"objects: expected .*got"):
        run_campaign(tmp_path / "none", load_hand("barrett"), tmp_path / "out")
    # jobs read the hand's files
    hand = load_hand("barrett")
    narrow = dataclasses.replace(hand.actuated, upper=0.5 * hand.upper)
    with pytest.raises(BadArgument, match=r"hand: expected .*got"):
        run_campaign(carton, dataclasses.replace(hand, actuated=narrow), tmp_path / "out")
    words = ["campaign", str(carton), "--hand", "barrett", "--out", str(tmp_path / "out")]
    for more, named in (
        (["--hand", "fist"], "--hand"),
        (["--fingers", "auto"], "--fingers"),
        (["--workers", "-1"], "--workers"),
        (["--seed", "-1"], "--seed"),
        (["--grasps", "0"], "--grasps"),
        (["--jobs-in-shard", "0"], "--jobs-in-shard"),
        (["--only", "jug"], "OBJECTS"),
        (["--licence", ""], "--licence"),
    ):
        assert cli.main([*words, *more]) == 2
        assert capsys.readouterr().err.startswith(f"torchgrasp: {named}: expected "), more
    assert list(tmp_path.iterdir()) == []


@pytest.mark.sim
def test_a_mesh_or_a_cloud_that_changed_is_another_campaign(
    data: Path, carton: Path, tmp_path: Path
):
    finished = tmp_path / "data"
    shutil.copytree(data, finished)
    for file in ("mesh.ply", "view0_noisy.ply"):
        changed = tmp_path / file
        shutil.copytree(carton, changed)
        run_campaign(changed, load_hand("barrett"), finished, QUICK)  # nothing is left to do
        path = changed / "carton" / file
        path.write_bytes(path.read_bytes()[:-12] + bytes(12))
        with pytest.raises(OutputError, match="other campaigns"):
            run_campaign(changed, load_hand("barrett"), finished, QUICK)


def test_other_versions_and_hands_on_a_machine_end_the_campaign(carton: Path):
    source = load_hand("barrett").source
    view = ObjectView(carton, "carton", "view0", source)
    spec = EvaluationSpec()
    with pytest.raises(BadArgument, match=r"workers: expected .*got one with"):
        job_module.run_job(view, LIFT, spec, {"campaign": "x", "versions": "{}"})
    other = dataclasses.replace(view, hand=source._replace(sha256="0"))
    with pytest.raises(BadArgument, match=r"hand: expected .*got"):
        job_module.run_job(
            other, LIFT, spec, {"campaign": "x", "versions": json.dumps(job_module.versions())}
        )
