"""Counts of launches, waits and uploads on the pretended device; and a list of the places where a
plan waits.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.devices.conftest import sent
from tests.devices.elsewhere import DEVICE, elsewhere
from tests.devices.launches import Launches
from torchgrasp import ContactSpec, load_object, plan_grasps
from torchgrasp.foundation.base import map_tensors
from torchgrasp.values.planning import PointCloud

KNOWN = {
    "outside": "",
    "cloud/agreement.py": "noise_of check_foot warn_of_low_table",
    "cloud/check.py": "_check _check_distinct _distinct_rows coordinate_step first_of_each",
    "cloud/neighbours.py": "_fit_block _principal_axes clean flat nearest",
    "cloud/prepare.py": "_fit_normals prepare_cloud share_facing",
    "cloud/surroundings.py": "find_surroundings",
    "cloud/viewpoint.py": "share_unseen",
    "geometry/frames.py": "virtual_frame",
    "geometry/linalg.py": "cholesky farthest_points number_rows",
    "geometry/optim.py": "levenberg_marquardt",
    "geometry/plane.py": "__post_init__ move round_upright upright_frame",
    "geometry/mesh_distance.py": "__init__",
    "geometry/signed_distance.py": "field_from_surface",
    "hand/fingers.py": "_refuse",
    "hand/hand.py": "jacobian",
    "hand/kinematics.py": "of",
    "hand/self_collision.py": "_choose _links clearance",
    "ik/attempts.py": "add best choose",
    "ik/candidates.py": "check_candidates rows",
    "ik/clearance.py": "link_clearance plane",
    "ik/joint.py": "solve",
    "ik/motion.py": "_clearance find_approach",
    "ik/seeds.py": "_drawn nearest_postures",
    "contacts/certify.py": "_prove check_unit forward",
    "contacts/form_closure.py": "_closed_in_plane _pivot closed_exact rank_ratio",
    "contacts/feasibility.py": "check_feasibility normal_variation",
    "contacts/problem.py": "of",
    "contacts/plan.py": "plan_chunk",
    "contacts/starts.py": "candidate_rows good_sets qualify settle_flatness",
    "planner/rows.py": "_drop_weak _carried _spread _table by_cloud choose find find_candidates select with_costs",
    "planner/report.py": "_tell end_batch",
    "planner/planner.py": "plan_objects solve_fixed step try_first try_fully without",
    "planner/run.py": "finish relax",
    "planner/objects.py": "digest pose reach relaxed_specs",
    "planner/ranking.py": "rank",
    "posture_model/mixture.py": "describe_compatibility",
    "posture_model/sample.py": "_draw_blocks",
    "shape/completion/complete.py": "complete_cloud",
    "shape/conditioning.py": "_extend append_observations longest_distance posterior_given rows",
    "shape/fit.py": "_warn_of_ambiguity fit_upright",
    "shape/gp.py": "of",
    "shape/posterior.py": "n_oriented",
    "shape/extra_observations.py": "camera_support frame_around free_space free_space_violations",
    "shape/surface.py": "_carry_cloud _grid _trace_wall collision_field mean",
    "shape/estimate.py": "least_noise normalise rows",
    "success/body.py": "around",
    "success/features.py": "_normal_deviation measure_grasps",
    "success/model.py": "depth",
    "success/order.py": "grade",
    "values/planning.py": "format_success select",
}
"""The functions in which a plan may wait for the device, by file. A function that waits no more is
to be deleted.
"""
MOST_READS = 1100
"""Most waits of a small plan: a quarter more than at present, since rounding moves the numbers of
steps.
"""

CALLS: dict[str, tuple[Callable[[Tensor], object], tuple[int, int, int]]] = {
    "arithmetic": (lambda x: (2 * x + 1).sum(), (3, 0, 0)),
    "views": (lambda x: x[1:].view(-1, 1).T.expand(5, 2).detach(), (0, 0, 0)),
    "nothing": (lambda x: x[:0] + 1, (0, 0, 0)),
    "memory": (torch.empty_like, (0, 0, 0)),
    "in place": (lambda x: x[1:].mul_(2), (1, 0, 0)),
    "a number": (lambda x: float(x[0]), (0, 1, 0)),
    "a condition": (lambda x: bool((x > 0).all()), (2, 1, 0)),
    "numbers": (lambda x: x.tolist(), (0, 1, 0)),
    "a copy to the host": (lambda x: x.cpu(), (0, 1, 0)),
    "a move to the host": (lambda x: x.to("cpu", torch.float32), (0, 1, 0)),
    "another type": (lambda x: x.float(), (1, 0, 0)),
    "a mask": (lambda x: x[x > 0], (2, 1, 0)),
    "indices of a mask": (lambda x: torch.nonzero(x), (1, 1, 0)),
    "a number for a mask": (lambda x: x.__setitem__(x > 0, 0.0), (2, 0, 0)),
    "indices of the host": (lambda x: x[torch.tensor([0, 2])], (1, 0, 1)),
    "a list of indices": (lambda x: x[[0, 2]], (1, 0, 1)),
    "indices of the device": (lambda x: x[torch.arange(2, device=DEVICE)], (2, 0, 0)),
    "numbers of the host": (lambda x: torch.tensor([1.0], device=DEVICE), (0, 0, 1)),
    "a tensor of the host": (lambda x: torch.ones(2).to(x), (0, 0, 1)),
    "a checked factor": (lambda x: torch.linalg.cholesky(torch.diag(x)), (2, 1, 0)),
    "work of the host": (lambda x: torch.ones(3) + 1, (0, 0, 0)),
}
"""Calls with their numbers of launches, reads and uploads."""


@pytest.mark.parametrize("name", CALLS)
def test_calls_have_the_counts_of_a_gpu(device, name):
    call, expected = CALLS[name]
    x = elsewhere(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    with Launches() as counted:
        call(x)
    assert tuple(counted.total(kind) for kind in ("launch", "read", "upload")) == expected


def test_counts_have_the_line_of_the_library_and_its_stage(device):
    cloud = PointCloud(elsewhere(torch.ones(5, 3).cumsum(0)))
    rows = elsewhere(torch.arange(4))
    with Launches({"select": "choice"}) as counted:
        map_tensors(
            torch.neg, cloud.select(rows)
        )  # a helper: its operations belong to the caller, which is this test
    places = {(at.file, at.function, at.stage) for kind, at in counted.found if kind == "launch"}
    assert places == {("values/planning.py", "select", "choice"), ("outside", "", "other")}


def test_a_plan_waits_for_the_device_only_where_it_is_known(device, hand):
    with Launches() as counted:
        plan_grasps(sent(load_object("cylinder").view), hand, ContactSpec(table=0.0), 8)
    known = {
        (file, function)
        for file, functions in KNOWN.items()
        for function in functions.split() or [""]
    }
    new = [
        str(at)
        for kind, at in counted.found
        if kind == "read" and (at.file, at.function) not in known
    ]
    assert not new, f"new waits for the device: {', '.join(sorted(new))}"
    assert counted.total("read") <= MOST_READS
