"""A folder with one object, and cheap plans and lifts."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from paper import trials

from tests.pinch import pinch
from torchgrasp.foundation.base import join
from torchgrasp.foundation.errors import Status
from torchgrasp.values.closing import ObjectMotion


@pytest.fixture(autouse=True)
def _simulator(request):
    """Skip simulations without SAPIEN."""
    if request.node.get_closest_marker("sim"):
        pytest.importorskip("sapien")


@pytest.fixture
def tin(tmp_path):
    """A folder with a standing cylinder, seen from one side."""
    folder = tmp_path / "objects"
    pose = np.eye(4)
    rng = np.random.default_rng(0)
    (folder / "tin").mkdir(parents=True)
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.12, sections=64).apply_translation(
        [0, 0, 0.06]
    )
    mesh.export(folder / "tin" / "mesh.ply")
    angle = (rng.random(700) - 0.5) * 2.9
    height = 0.12 * rng.random(700)
    seen = np.stack([0.03 * np.cos(angle), 0.03 * np.sin(angle), height], -1)
    trimesh.PointCloud(seen).export(folder / "tin" / "view0_noisy.ply")
    pose[:3, 3] = [0.45, 0.0, 0.15]
    entry = {
        "views": {"view0": {"T_object_camera": pose.tolist()}},
        "family": "tin",
        "group": "solid",
    }
    (folder / "manifest.json").write_text(json.dumps({"objects": {"tin": entry}}))
    return folder


@pytest.fixture
def steps(monkeypatch):
    """Make planning and lifting of campaigns cheap; the step with number `stop` is interrupted."""
    seen = SimpleNamespace(count=0, stop=None)

    def step():
        seen.count += 1
        if seen.count == seen.stop:
            raise KeyboardInterrupt

    def plan(cloud, hand, spec, starts, seed, *, shape):
        step()
        _, grasp = pinch(hand.name)
        stds = [torch.full((1, 3), 1e-3 * k, dtype=torch.float64) for k in (1, 2, 3)]
        contacts = [dataclasses.replace(grasp.contacts, std_m=std, variance=std**2) for std in stds]
        return join([dataclasses.replace(grasp, contacts=x) for x in contacts])

    def lift(grasp, hand, mesh, spec, seed, *, parts, error):
        step()
        motion = ObjectMotion(1e-6 * (seed % 1000), 0.1)
        status = Status.OK if seed % 3 else Status.DROPPED
        return SimpleNamespace(status=status, pushed=motion, slip=motion, contact_order=(1, 0, 2))

    monkeypatch.setattr(trials, "list_objects", lambda: ("cylinder", "jug"))
    monkeypatch.setattr(trials, "fit_shape", lambda cloud, *, support, seed, table: support)
    monkeypatch.setattr(trials, "plan_grasps", plan)
    monkeypatch.setattr(trials, "close_hand", lift)
    return seen
