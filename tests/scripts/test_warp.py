"""Pulls of several objects at once in MuJoCo Warp, on the CPU: each ends as in MuJoCo alone."""

import dataclasses
import math
import sys

import pytest
import torch
import trimesh
from benchmarks.gpu.warp_pulls import pull_grasps

from tests.pinch import HEIGHT, cylinder, pinch
from torchgrasp.evaluation import PROTOCOLS, GraspTrial, PullSpec, Truth, pull_grasp
from torchgrasp.foundation.errors import BadArgument, MissingExtra, Status

pytestmark = [pytest.mark.sim, pytest.mark.filterwarnings("ignore")]
PROTOCOL = dataclasses.replace(
    PROTOCOLS["dexgraspbench"].with_trial(
        mass=0.05, simulator="mujoco", timestep=0.004, overlap=1e-3
    ),
    pull=PullSpec(10.0, 0.2, 0.05, math.radians(15)),
)


def halves():
    """The upper and the lower half of the cylinder."""
    middle = (0.0, 0.0, HEIGHT / 2)
    return [
        trimesh.intersections.slice_mesh_plane(cylinder(), (0, 0, z), middle, cap=True)
        for z in (1, -1)
    ]


def pinched(parts=None, ahead=0.0, name="allegro"):
    """A trial of the pinch in which the hand stands ahead of its place, along its own z axis."""
    hand, grasp = pinch(name)
    error = torch.eye(4, dtype=torch.float64)
    error[2, 3] = ahead
    return GraspTrial(hand, grasp, Truth(cylinder(), parts, error))


def test_trials_at_once_end_as_each_alone():
    pytest.importorskip("mujoco_warp")
    trials = [pinched(), pinched(halves()), pinched(ahead=0.2), pinched(halves(), ahead=-0.05)]
    here = pull_grasps(trials, PROTOCOL, "cpu")
    there = [pull_grasp(trial, PROTOCOL) for trial in trials]
    assert [x.status for x in there] == [Status.OK, Status.OK, Status.MOVED, Status.START_OVERLAP]
    assert [(x.status, x.passed, x.directions) for x in here] == [
        (x.status, x.passed, x.directions) for x in there
    ]
    for one, other in zip(here, there, strict=True):
        assert one.moved == pytest.approx(other.moved, abs=2e-4)
        assert one.turned == pytest.approx(other.turned, abs=1e-3)
    with pytest.raises(BadArgument, match=r"device: expected .*got 'cuda:77'"):
        pull_grasps(trials, PROTOCOL, "cuda:77")


def test_bad_arguments_and_a_missing_package_are_named(monkeypatch):
    for trials, protocol, message in (
        ([pinched()], "paper", "protocol: expected one that closes in open loop"),
        (
            [pinched()],
            PROTOCOL.with_trial(closing="uncertainty"),
            "protocol: expected one that closes in open loop",
        ),
        ([pinched(), pinched(name="barrett")], PROTOCOL, "trials: expected .*got 2 hands"),
        ([], PROTOCOL, "trials: expected .*got 0 hands"),
    ):
        with pytest.raises(BadArgument, match=message):
            pull_grasps(trials, protocol, "cpu")
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(MissingExtra, match=r"mujoco_warp.*torchgrasp\[warp\]"):
        pull_grasps([pinched()], PROTOCOL, "cpu")
