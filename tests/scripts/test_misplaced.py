"""Trials of misplaced objects: errors are of the size they are named by, and a campaign goes on where it was."""

import math
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import trimesh
from benchmarks.close import misplaced
from paper.trials import Subject, TableSpec
from scipy.spatial.transform import Rotation

from tests.pinch import cylinder, pinch
from torchgrasp.base import join
from torchgrasp.geometry.frames import inverse, rigid, rotation_from_vector


@pytest.mark.parametrize("condition", ["in place", "20 mm", "10 degrees", "afloat, 10 mm"])
def test_the_object_is_off_by_what_the_condition_says_and_stays_on_its_table(condition):
    wrong, mesh, (_, grasp) = misplaced.CONDITIONS[condition], cylinder((0.02, 0.01)), pinch("allegro")
    planned, centre = grasp.obj_from_hand[0].double(), torch.tensor([*mesh.center_mass, 1.0])
    for seed in range(20):
        error = misplaced._misplace(wrong, grasp, mesh, seed)
        moved = planned @ inverse(planned @ error)  # of the object, in the frame in which the hand stands as planned
        assert float((moved @ centre - centre).norm()) == pytest.approx(wrong.distance, abs=1e-9)
        turned = Rotation.from_matrix(moved[:3, :3].numpy()).as_rotvec()
        assert math.hypot(*turned) == pytest.approx(wrong.angle, abs=1e-7)
        if not wrong.afloat:
            assert abs(float((moved @ centre - centre)[2])) < 1e-9 and abs(turned[:2]).max() < 1e-9


def test_what_was_tried_is_kept_and_only_the_rest_is_tried_anew(tmp_path, monkeypatch):
    _, grasp = pinch("allegro")
    mesh, tried = trimesh.creation.icosphere(2, 0.03), []

    def run(trial, wrong, law, mass, seed):
        tried.append((law, float(trial.error[0, 3])))
        return {"status": "OK", "moved": 1.0, "unbalanced": 0.1}

    monkeypatch.setattr(misplaced, "_run", run)
    monkeypatch.setattr(misplaced, "_plan", lambda *_: join([grasp, grasp, grasp]))
    monkeypatch.setattr(misplaced, "_read_solid", lambda *_: (mesh, [mesh]))
    monkeypatch.setattr(misplaced, "_fit", lambda *_: (None, None))
    monkeypatch.setattr(misplaced, "list_views", lambda *_, **__: [("ball", "view0")])
    monkeypatch.setattr(misplaced, "read_mass", lambda *_: None)
    spec = TableSpec(tmp_path, (tmp_path,), hands=("allegro",), own=False, grasps=3, starts=20, workers=0, seed=0)
    subject = Subject(Path(tmp_path), "ball", "balls", "solid")
    first = misplaced.try_object(spec, subject, "allegro", "20 mm", ("uncertainty",))
    assert [one["rank"] for one in first] == [0, 1, 2] and len(tried) == 3
    both = misplaced.try_object(spec, subject, "allegro", "20 mm", ("uncertainty", "open_loop"))
    assert len(both) == 6 and len(tried) == 6
    assert misplaced.try_object(spec, subject, "allegro", "20 mm", ("uncertainty",)) == first
    errors = [error for _, error in tried]
    assert errors[:3] == errors[3:] and len(set(errors)) == 3  # laws are paired, grasps are not alike


@pytest.mark.parametrize(("arrival", "moved"), [(0.1, 0.0), (0.2, 30.0), (math.nan, 50.0)])
def test_early_motion_is_that_of_the_centre_until_the_hand_arrived(arrival: float, moved: float):
    """The object turns about its centre, then is shifted twice."""
    mesh = cylinder((0.02, 0.01))
    centre = torch.tensor(mesh.center_mass.tolist(), dtype=torch.float64)
    rotation = rotation_from_vector(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    shifts = torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [0.03, 0, 0], [0.03, 0.04, 0]], dtype=torch.float64)
    turns = [torch.eye(3, dtype=torch.float64), rotation, rotation, rotation]
    poses = [rigid(turn, centre + shift - turn @ centre) for turn, shift in zip(turns, shifts, strict=True)]
    time = torch.tensor([0.0, 0.1, 0.2, 0.3], dtype=torch.float64)
    done = SimpleNamespace(
        time=time, object_pose=torch.stack(poses), phases=torch.tensor([arrival], dtype=torch.float64)
    )
    assert misplaced._moved_early(done, mesh) == pytest.approx(moved, abs=1e-6)


def test_what_is_lost_in_place_too_is_counted_by_object_rank_and_law():
    def lost(rank: int, condition: str, law: str = "uncertainty", status: str = "SLIPPED", early: float = 0.0):
        return misplaced.Outcome("ball", "balls", "allegro", rank, condition, law, status, 1.0, 0.1, 1.0, 4.0, early)

    in_place = [lost(0, "in place"), lost(1, "in place", status="OK"), lost(2, "in place", "open_loop")]
    mine = [lost(0, "20 mm"), lost(1, "20 mm", early=9.0), lost(2, "20 mm"), lost(3, "20 mm", status="OK", early=9.0)]
    words = misplaced._when_lost(mine, in_place)
    assert words == ["2 were moved by over 5 mm in the approach, 1 of them lost", "1 are lost in place, too"]
    assert len(misplaced._when_lost(in_place, in_place)) == len(misplaced._when_lost(mine, [])) == 1
