"""The impedance of a held object: wrenches that restore, forces that balance, what the drives make
of both.
"""

import pytest
import torch

from tests.point_fingers import PERIOD, TOUCHING, observation, real, reference
from torchgrasp.contacts.balance import grasp_map
from torchgrasp.control.finger_forces import PreferredForces
from torchgrasp.control.holding import RAMP, held_forces
from torchgrasp.control.paper.closings import (
    ROTATION_STIFFNESS,
    TRANSLATION_STIFFNESS,
    Impedance,
    restoring_wrench,
    shared_forces,
    side_lengths,
    spring_forces,
)
from torchgrasp.control.paper.stability import StabilityModel
from torchgrasp.geometry.frames import rigid, rotation_from_vector, virtual_frame


def triangles(count: int, seed: int = 0) -> torch.Tensor:
    return 0.05 * torch.randn(
        count, 3, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


def wrench_of(points: torch.Tensor, forces: torch.Tensor) -> torch.Tensor:
    """Sum forces and their torques about the centre, contact by contact."""
    arms = points - points.mean(-2, keepdim=True)
    return torch.cat([forces.sum(-2), torch.linalg.cross(arms, forces).sum(-2)], -1)


def energy(points: torch.Tensor, rest: torch.Tensor, turned: torch.Tensor) -> torch.Tensor:
    """Of the impedance alone, written as a potential: translation, and 1 - cos of each axis' turn."""
    frame = virtual_frame(points @ turned.T)
    slide = (frame[:3, 3] - rest[:3, 3]).square().sum()
    turn = 0.5 * (1 - (frame[:3, :3] * rest[:3, :3]).sum(0)).sum()
    return 0.5 * TRANSLATION_STIFFNESS * slide + ROTATION_STIFFNESS * turn


def test_shared_forces_are_the_smallest_for_the_wrench_and_spring_forces_balance():
    points = triangles(20)
    wrench = torch.randn(20, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    forces = shared_forces(points, wrench, torch.full((20,), 1e9).double())
    assert torch.allclose(wrench_of(points, forces), wrench, atol=1e-9)
    assert torch.allclose(
        (grasp_map(points) @ forces.flatten(-2)[..., None])[..., 0], wrench, atol=1e-9
    )
    for k in range(20):
        least = torch.linalg.lstsq(grasp_map(points[k]), wrench[k], driver="gelsd").solution
        assert float(forces[k].norm()) <= float(least.norm()) * (1 + 1e-9)
    capped = shared_forces(points, wrench, torch.full((20,), 0.1).double())
    assert torch.allclose(capped.norm(dim=-1).amax(-1), torch.tensor(0.1).double())
    assert torch.allclose(capped / capped.norm(), forces / forces.norm(), atol=1.0)
    stiffness = torch.tensor([10.0, 200.0, 70.0]).double().expand(20, 3)
    forces = spring_forces(points, side_lengths(points) - 0.01, stiffness)
    assert wrench_of(points, forces).abs().max() < 1e-12
    along = ((points.roll(-1, -2) - points) * (forces - forces.roll(-1, -2))).sum(-1)
    assert (along.sum(-1) > 0).all()
    assert spring_forces(points, side_lengths(points), stiffness).abs().max() == 0


def test_restoring_wrench_is_the_gradient_of_an_energy():
    """A turn by v about the origin changes the energy by -torque . v, a shift by d by -force . d."""
    points = triangles(1)[0]
    rest = virtual_frame(
        points @ rotation_from_vector(real([0.3, -0.2, 0.1])).T + real([0.004, -0.002, 0.001])
    )
    centre = points.mean(0)
    wrench = restoring_wrench(virtual_frame(points), rest)

    def moved(v: torch.Tensor) -> torch.Tensor:
        there = (points - centre) @ rotation_from_vector(v[3:]).T + centre + v[:3]
        return energy(there, rest, torch.eye(3).double())

    for k in range(6):
        step = 1e-6 * torch.eye(6).double()[k]
        slope = (moved(step) - moved(-step)) / 2e-6
        assert float(slope) == pytest.approx(-float(wrench[k]), rel=1e-5, abs=1e-8)


def test_impedance_at_rest_presses_with_the_desired_forces():
    seen = observation(0.0, contact=TOUCHING, reading=(2.0, 2.0, 4.0))
    hold = Impedance(reference(), seen, torch.zeros(9).double())
    first = hold(seen, PERIOD)
    assert first.abs().max() < 0.1
    last = [hold(seen, PERIOD) for _ in range(round(RAMP / PERIOD))][-1]
    forces, _ = held_forces(reference(), seen)
    assert torch.allclose(2.0 * last.reshape(3, 3), forces, atol=1e-9)


def test_impedance_restores_a_moved_grasp_in_any_frame_and_keeps_its_own_for_tips_on_a_line():
    seen = observation(0.0, contact=TOUCHING, reading=(2.0, 2.0, 4.0))
    hold = Impedance(reference(), seen, torch.zeros(9).double())
    tips = seen.tips
    rest = hold.forces(seen.tips)
    shift = real([0.0, 0.001, 0.0])
    assert torch.allclose(
        (hold.forces(tips + shift) - rest).sum(0), -TRANSLATION_STIFFNESS * shift, atol=1e-9
    )
    turn = rotation_from_vector(real([0.0, 0.0, 0.05]))
    centre = tips.mean(0)
    there = (tips - centre) @ turn.T + centre
    torque = torch.linalg.cross(there - centre, hold.forces(there)).sum(0)
    assert float(torque[2]) == pytest.approx(-ROTATION_STIFFNESS * 0.05, rel=0.01)
    far = hold.forces(tips + 100 * shift) - rest
    assert float(far.norm(dim=-1).max()) == pytest.approx(float(rest.norm(dim=-1).max()))
    seen = observation(0.0, contact=TOUCHING)
    hold, turned = (Impedance(reference(), seen, torch.zeros(9).double()) for _ in range(2))
    line = seen.tips.mean(0) + torch.arange(3)[:, None] * real([0.01, 0.0, 0.0])
    assert torch.isfinite(hold.forces(line)).all()
    assert torch.equal(hold.frame, hold.rest)
    moved = seen.tips + 0.002 * triangles(1, 3)[0] / 0.05
    there = rigid(rotation_from_vector(real([0.5, 0.2, -0.8])), real([0.1, 0.0, 0.2]))
    turned.rest = there @ hold.rest
    forces = turned.forces(moved @ there[:3, :3].T + there[:3, 3])
    assert torch.allclose(forces, hold.forces(moved) @ there[:3, :3].T, atol=1e-9)


def test_impedance_firms_an_unstable_grasp_only():
    class Model(StabilityModel):
        """Stable is what presses with more than 5 N in all."""

        def __init__(self) -> None:
            pass

        def log_odds(self, state: torch.Tensor) -> torch.Tensor:
            return state[6:].exp().sum() - 5.0

        def preferred_forces(
            self, tips: torch.Tensor, force: float | None = None
        ) -> PreferredForces:
            return PreferredForces(
                torch.ones(3).double(), torch.eye(3).double(), torch.full((3,), 300.0).double()
            )

    def held(reading: tuple[float, float, float], **options) -> Impedance:
        seen = observation(0.0, contact=TOUCHING, reading=reading)
        hold = Impedance(reference(), seen, torch.zeros(9).double(), **options)
        for _ in range(round((RAMP + 1.3) / PERIOD)):
            hold(seen, PERIOD)
        return hold

    firm = held((2.0, 2.0, 4.0), stability=Model())
    weak = held((1.0, 1.0, 2.0), stability=Model())
    assert firm.raised == 1.0
    assert weak.raised == pytest.approx(2.0, rel=0.01)
    assert weak.springs.tolist() == pytest.approx([300.0] * 3, rel=0.01)
    assert (
        weak.forces(observation(0.0).tips).norm() > 1.9 * firm.forces(observation(0.0).tips).norm()
    )
    kept = held((1.0, 1.0, 2.0), springs=torch.full((3,), 50.0).double())
    assert (kept.raised, kept.springs.tolist()) == (1.0, [50.0] * 3)


def test_impedance_drives_coupled_joints_by_their_actuator():
    """Three actuators move three joints each: the generalised torque is C^T J^T f whatever their
    stiffness.
    """
    coupling = torch.kron(torch.eye(3), torch.tensor([[1.0], [0.5], [0.25]])).double()
    body = reference(coupling)
    joints = 0.01 * torch.randn(9, generator=torch.Generator().manual_seed(2)).double()
    seen = observation(0.0, contact=TOUCHING, joints=joints)
    hold = Impedance(body, seen, seen.joints)
    targets = [hold(seen, PERIOD) for _ in range(round(RAMP / PERIOD) + 1)][-1]
    torque = coupling.T @ (body.kp * (targets - seen.joints))
    wanted = coupling.T @ (seen.jacobian.flatten(0, 1).T @ hold.forces(seen.tips).flatten())
    assert torch.allclose(torque, wanted, atol=1e-9)
