"""Each hand is read once for all tests of the planner; shapes are estimated, and observed runs
planned, once.
"""

import pytest

from tests.make import load_hand
from torchgrasp import ContactSpec, load_object, plan_grasps

RUNS = [("allegro", "joint"), ("barrett", "joint"), ("barrett", "contact_first")]


@pytest.fixture(scope="module", autouse=True)
def hands_once(kept):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("torchgrasp.hand.load.load_hand", load_hand)
        patch.setattr("torchgrasp.planner.changes.load_hand", load_hand)
        yield


@pytest.fixture(scope="session", params=RUNS, ids="-".join)
def run(request):
    """A hand, its grasps of the shipped cylinder on a table, and the stages by name."""
    stages = {}
    name, mode = request.param
    note = lambda stage, text, value: stages.update({stage: value})  # noqa: E731
    view = load_object("cylinder").view
    spec = ContactSpec(table=0.0)
    grasps = plan_grasps(view, load_hand(name), spec, starts=48, mode=mode, observer=note)
    return load_hand(name), grasps, stages
