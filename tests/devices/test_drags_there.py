"""Drags of an object whose cloud and table are on a device."""

import torch

from tests.devices.conftest import at_home, sent
from tests.devices.elsewhere import DEVICE
from tests.dragged import DISTANCE, FRICTION, TABLE_FRICTION, VIEW, ending
from tests.make import load_hand
from torchgrasp import ContactSpec
from torchgrasp.foundation.base import named_tensors
from torchgrasp.planner.edge import plan_edge_grasps


def test_a_drag_is_that_of_the_cpu_and_the_grasps_are_where_the_cloud_is(device):
    hand = load_hand("barrett")
    spec = ContactSpec(FRICTION, table=ending(DISTANCE))
    options = {"starts": 4, "table_friction": TABLE_FRICTION}
    here = at_home(lambda: plan_edge_grasps(VIEW, hand, spec, **options))
    there = plan_edge_grasps(sent(VIEW), hand, sent(spec), **options)
    assert all(x.device == DEVICE for x in named_tensors(there.grasps).values())
    found = named_tensors(there.drag)
    for name, x in named_tensors(here.drag).items():
        assert found[name].device.type == "cpu" and found[name].dtype == x.dtype
        y = found[name].as_subclass(torch.Tensor)
        torch.testing.assert_close(y, x, rtol=0, atol=1e-6, equal_nan=True, msg=name)
