"""Where the object is by touch: against a general optimiser, rigid motions, and a block that stands
elsewhere.
"""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from tests.point_fingers import NORMALS, PERIOD, close_on_block, real, reference
from torchgrasp import GraspController, Plane
from torchgrasp.control.law import surface_covariance
from torchgrasp.control.object_pose import ContactPlanes
from torchgrasp.control.uncertainty_closing import PALM_SPEED
from torchgrasp.geometry.linalg import unit
from torchgrasp.values.closing import ClosingOptions

AROUND = unit(real([[1, 0.3, 0.1], [-0.4, 1, 0], [-0.5, -0.9, 0.2]]))
"""Normals that span the plane across z, and a little more."""


def known(normals=AROUND, std_mm=(1.0, 3.0, 6.0), table=True):
    """A reference of contacts 30 mm from the origin, on a table across z."""
    start = reference()
    covariance = surface_covariance(normals, 1e-3 * real(std_mm))
    gains = dataclasses.replace(start.gains, target=0.03 * normals, covariance=covariance)
    plane = Plane(real([0, 0, 1]), -0.05) if table else None
    return dataclasses.replace(start, normals=normals, gains=gains, table=plane)


@pytest.mark.parametrize("table", [True, False])
@pytest.mark.parametrize("touching", [(1, 0, 0), (0, 1, 1), (1, 1, 1), (0, 0, 0)])
@pytest.mark.parametrize("off_mm", [(8.0, 2.0, 9.0), (-3.0, 5.0, -6.0), (4.0, -9.0, -8.0)])
def test_displacement_is_the_likeliest(table, touching, off_mm):
    """The posterior by SciPy: a touch measures a plane, a finger in the air costs only where the
    plane passes it.
    """
    held = known(table=table)
    normals = AROUND.numpy()
    off = 1e-3 * np.array(off_mm)
    felt = np.array(touching, dtype=bool)
    target = held.gains.target.numpy()
    arms = target - target.mean(0)
    place = np.array([0.01, 0.01, 0.001 if table else 0.01])
    turn = np.array([0.01, 0.01, 0.09]) if table else np.full(3, 0.09)
    variance = np.array(
        [n @ c @ n for n, c in zip(normals, held.gains.covariance.numpy(), strict=True)]
    )

    def cost(scaled):
        shift = scaled[:3] * place
        rotation = scaled[3:] * turn
        plane = ((shift + np.cross(rotation, arms)) * normals).sum(-1)
        miss = np.where(felt, plane - off, np.maximum(plane - off, 0.0))
        return 0.5 * (scaled**2).sum() + 0.5 * (miss**2 / variance).sum()

    best = minimize(cost, np.zeros(6), method="BFGS", options={"gtol": 1e-10}).x
    found = ContactPlanes(held).displacement(
        held.gains.target + real(off)[:, None] * AROUND, torch.tensor(felt)
    )
    assert np.allclose(found.numpy(), best * np.concatenate([place, turn]), atol=2e-6)


def test_displacement_by_certain_contacts_stays_on_the_table():
    flat = unit(AROUND * real([1, 1, 0]))
    held = known(flat, std_mm=(0.0, 0.0, 0.0))
    shift = real([0.006, -0.004, 0.0])
    sure = dataclasses.replace(held.gains, covariance=held.gains.covariance / 1e4)
    planes = ContactPlanes(dataclasses.replace(held, gains=sure))
    off = (shift * flat).sum(-1)
    found = planes.displacement(
        held.gains.target + off[:, None] * flat, torch.ones(3, dtype=torch.bool)
    )
    moved = planes.moved(found) - held.gains.target
    assert torch.allclose((moved * flat).sum(-1), off, atol=5e-5)
    assert float(found[2].abs()) < 1e-6 and float(moved[:, 2].abs().max()) < 1e-4


def test_displacement_follows_the_more_certain_touch_and_is_bounded_in_the_air():
    opposed = real([[1, 0, 0], [-1, 0, 0], [0, 1, 0]])
    felt = torch.tensor([True, True, False])
    for std_mm, sign in (((1.0, 9.0, 1.0), 1.0), ((9.0, 1.0, 1.0), -1.0)):
        held = known(opposed, std_mm)
        found = ContactPlanes(held).displacement(held.gains.target + 0.008 * opposed, felt)
        assert float(found[0]) * sign > 1e-3
    held = known()
    touching = torch.tensor([False, False, False])
    near, far = (
        ContactPlanes(held).displacement(held.gains.target - off * AROUND, touching)
        for off in (0.025, 0.25)
    )
    assert torch.allclose(near, far)


def close(controller: GraspController, away: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Close on a block that stands `away` [m] along x; return the path of palm and joints."""
    path = []
    for _, targets in close_on_block(controller, 3.5, 0.02, away):
        path.append(torch.cat([targets.palm, targets.joints]))
        if controller.closing.done:
            break
    palms, angles = torch.stack(path).split([3, 9], 1)
    return palms, angles.reshape(-1, 3, 3)


@pytest.mark.parametrize("closing", ["uncertainty", "fixed"])
def test_palm_follows_a_displaced_block(closing):
    palms, joints = close(GraspController(reference(), closing), 0.01)
    assert palms[-1].numpy() == pytest.approx([0.01, 0, 0], abs=2.5e-3)
    assert (palms[1:] - palms[:-1]).norm(dim=-1).max() <= PALM_SPEED * PERIOD + 1e-9
    posture = joints[-1] + 0.02 * NORMALS  # zero where each tip is at its planned contact
    assert (posture * NORMALS).sum(-1).abs().max() < 3e-3
    still, moved = close(
        GraspController(reference(), closing, options=ClosingOptions(palm_reach=0.0, stops=0)), 0.01
    )
    assert still.abs().max() == 0
    assert ((moved[-1] + 0.02 * NORMALS) * NORMALS).sum(-1).abs().max() > 8e-3


def test_palm_moves_within_its_reach_or_stays():
    for closing in ("paper", "position", "open_loop"):
        assert close(GraspController(reference(), closing), 0.01)[0].abs().max() == 0
    assert close(GraspController(reference()), 0.0)[0].norm(dim=-1).max() < 1e-3
    far = close(GraspController(reference()), 0.018)[0].norm(dim=-1)
    assert 0.01 < float(far.max()) <= ClosingOptions().palm_reach + 1e-9
