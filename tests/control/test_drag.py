"""The controller of a drag on a world of springs: fingertips that bend, stick and slip on a block that
slides on its table.
"""

import dataclasses
import functools

import numpy as np
import pytest
import torch

from tests.make import load_hand, near, real
from tests.settings import other_settings
from torchgrasp import Plane, Status
from torchgrasp.control import Observation, TipContact, feel_flags, measure, no_contact, observe
from torchgrasp.control.drag import DRAGGING, DragController
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import inverse
from torchgrasp.ik.press import press_postures
from torchgrasp.planner.drag_plan import DragPlan, _is_steady

PERIOD = 0.01
THICK = 0.01
"""Height [m] of the block."""
WEIGHT = 2.0
"""Weight [N] of the block."""
FRICTION = 0.6
TABLE_FRICTION = 0.2
LENGTH = 0.08
"""Length [m] of the drag."""
SURE = 1e-3
"""Relative error of the world's balance of forces."""
UP = real([0.0, 0.0, 1.0])


@functools.cache
def made(name):
    """A hand, a plan in the frame of a pressing posture with two tips, and the tips' stiffness.

    The posture bends the tips sideways, too, and is among the softest ones.
    """
    hand = load_hand(name)
    postures = press_postures(hand)
    ways = real([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    good = _is_steady(postures, ways) & (postures.presses.sum(1) == 2)[:, None]
    soft = (postures.stiffness @ UP)[..., 2].where(postures.presses, torch.inf).amin(1)
    row = int(soft.where(good.any(1), torch.inf).argmin())
    way = ways[int(good[row].int().argmax())]
    presses = postures.presses[row]
    plan = DragPlan(
        joints=postures.joints[row],
        obj_from_hand=postures.press_from_hand[row],
        presses=presses,
        feet=postures.feet[row].where(presses[:, None], torch.nan),
        displacement=LENGTH * way,
        force=4.0,
        table=Plane.horizontal(-THICK),
    )
    return hand, plan, postures.stiffness[row][presses].numpy()


class Springs:
    """A block under a hand whose joints stay: its fingertips are springs (k, 3, 3) [N/m].

    Everything is in the posture's frame. Where tips and block stick, forces follow from the springs;
    where they exceed Coulomb's law, anchors and block move until they do not.

    `top` is the height [m] of the block above the planned one, and `ends` the distance [m] from the
    start behind which the block has no top along the drag. `share` is that of the fingers' planned
    stiffness.
    """

    def __init__(self, name, top=0.0, ends=np.inf, noise=None, share=1.0):
        self.hand, self.plan, stiffness = made(name)
        self.stiffness = share * stiffness
        self.top = top
        self.ends = ends
        self.generator = None if noise is None else torch.Generator().manual_seed(noise)
        self.feet = self.plan.feet[self.plan.presses].numpy()
        self.joints = self.hand.expand_joints(self.plan.joints)
        self.tips = self.hand.tip_centres(self.plan.joints)
        self.anchor = np.full_like(self.feet, np.nan)  # on the block
        self.block = np.zeros(2)
        self.forces = np.zeros_like(self.feet)
        self.bend = np.zeros_like(self.feet)
        self.state = no_contact(fingers=len(self.hand.tips))
        self.most = self.deepest = self.bent = 0.0

    def settle(self, palm):
        """Bring tips and block to rest for a place (3,) [m] of the palm."""
        way = self.plan.displacement.numpy()[:2] / LENGTH
        free = self.feet + palm
        touch = (free[:, 2] < self.top) & (
            (free[:, :2] - self.block - self.feet[:, :2]) @ way < self.ends
        )
        new = touch & np.isnan(self.anchor[:, 0])
        self.anchor[new] = free[new]
        self.anchor[new, :2] -= self.block
        self.anchor[~touch] = np.nan
        stiffness = self.stiffness
        for _ in range(100):
            tips = self.anchor + np.r_[self.block, 0.0]
            tips[:, 2] = self.top
            bend = np.where(touch[:, None], tips - free, 0.0)
            force = -np.einsum("kij,kj->ki", stiffness, bend)
            pressed = np.maximum(-force[:, 2], 0.0)
            across = np.linalg.norm(force[:, :2], axis=1)
            slips = touch & (across > (1 + SURE) * FRICTION * pressed)
            net = force[touch, :2].sum(0)
            size = np.linalg.norm(net)
            holds = TABLE_FRICTION * (WEIGHT + pressed.sum())
            if size > (1 + SURE) * holds:
                soft = stiffness[touch][:, :2, :2].sum(0)
                self.block += np.linalg.solve(soft, (1 - holds / size) * net)
            elif slips.any():
                for k in np.flatnonzero(slips):
                    share = 1 - FRICTION * pressed[k] / across[k]
                    soft = stiffness[k, :2, :2]
                    self.anchor[k, :2] += np.linalg.solve(soft, share * force[k, :2])
            else:
                break
        self.forces = np.where(pressed[:, None] > 0, force, 0.0)
        self.bend = bend
        self.most = max(self.most, pressed.sum())
        self.bent = max(self.bent, np.linalg.norm(bend[:, :2], axis=1).max())

    def feel(self):
        """What the hand measures."""
        on = self.plan.presses
        turn = self.plan.obj_from_hand[:3, :3]
        f = len(on)
        forces = torch.zeros(f, 3).double()
        forces[on] = torch.from_numpy(self.forces) @ turn
        normals = (UP @ turn).expand(f, 3)
        pressed = -(forces * normals).sum(1)
        tips = self.tips.clone()
        tips[on] += torch.from_numpy(self.bend) @ turn
        truth = TipContact(pressed, forces, tips, normals.clone())
        radius = self.hand.tips.radius
        self.state = measure(self.state, truth, normals.clone(), radius, PERIOD, self.generator)
        jacobian = torch.zeros(f, 3, len(self.joints)).double()
        return Observation(self.joints, tips, jacobian, self.state)

    def run(self):
        """Drag the block; return the controller and the pressing forces of each phase [N]."""
        controller = DragController(self.plan, self.hand)
        forces = {"down": [], "drag": [], "up": []}
        for _ in range(3000):
            if controller.phase == "done":
                break
            phase = controller.phase
            targets = controller.step(self.feel(), PERIOD)
            assert torch.equal(targets.joints, self.joints)
            assert torch.equal(targets.palm, controller.targets.palm)
            palm = (self.plan.obj_from_hand[:3, :3] @ targets.palm).numpy()
            self.deepest = min(self.deepest, palm[2])
            self.settle(palm)
            forces[phase].append(-self.forces[:, 2].sum())
        assert controller.phase == "done"
        assert palm[2] >= DRAGGING.height
        return controller, forces


@pytest.mark.parametrize(
    ("name", "share", "noise"),
    [("allegro", 1.0, None), ("allegro", 0.25, 0), ("barrett", 0.25, None), ("barrett", 0.25, 0)],
)
def test_the_block_goes_as_far_as_planned_although_the_fingers_bend(name, share, noise):
    world = Springs(name, noise=noise, share=share)
    controller, forces = world.run()
    assert controller.status is Status.OK
    assert world.bent > (1e-3 if share == 1.0 else 4e-3)
    planned = world.plan.displacement[:2].numpy()
    assert np.linalg.norm(world.block - planned) < (1e-3 if noise is None else 1.5e-3)
    assert forces["down"][-1] > 0.8 * world.plan.force
    middle = forces["drag"][len(forces["drag"]) // 4 :]
    assert np.mean(middle) == pytest.approx(world.plan.force, rel=0.15)
    assert world.most < 1.6 * world.plan.force


@pytest.mark.parametrize("top", [-0.005, 0.02])
def test_a_block_of_another_height_is_pressed_as_planned(top):
    world = Springs("allegro", top=top)
    controller, _ = world.run()
    assert controller.status is Status.OK
    assert np.linalg.norm(world.block - world.plan.displacement[:2].numpy()) < 1e-3
    assert world.most < 2 * world.plan.force


@pytest.mark.parametrize("noise", [None, 0])
def test_a_hand_that_finds_nothing_rises_before_it_is_far_below_the_table(noise):
    world = Springs("allegro", top=-1.0, noise=noise)
    controller, forces = world.run()
    assert controller.status is Status.NO_CONTACT
    assert not forces["drag"]
    speed = DRAGGING.touching * PERIOD
    assert -THICK > world.deepest > -THICK - DRAGGING.below - 2 * speed
    assert not world.block.any()


def test_a_hand_that_loses_the_block_on_the_way_rises_at_once():
    # the tips slip off: the table holds the block, and its top ends
    world = Springs("barrett", ends=0.02)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.control.test_drag.TABLE_FRICTION", 5.0)
        controller, forces = world.run()
    assert controller.status is Status.NO_CONTACT
    assert forces["drag"] and len(forces["drag"]) < LENGTH / DRAGGING.speed / PERIOD
    assert np.linalg.norm(world.block) < 1e-3
    assert world.deepest > -DRAGGING.deepest


def test_a_hand_too_soft_to_press_gives_up():
    world = Springs("allegro", share=0.01)
    controller, forces = world.run()
    assert controller.status is Status.NO_CONTACT and not forces["drag"]
    assert world.deepest > -DRAGGING.deepest - 1e-3


def test_plans_that_fit_no_drag_of_the_hand_are_refused():
    hand, plan, _ = made("allegro")
    with pytest.raises(BadArgument, match=r"plan: expected 4 and 3, as the hand has"):
        DragController(plan, load_hand("barrett"))
    # a hand with as many joints and fingertips
    with pytest.raises(BadArgument, match=r"plan: expected a plan of this hand"):
        DragController(plan, load_hand("leap"))
    still = dataclasses.replace(plan, displacement=torch.zeros(3).double())
    with pytest.raises(BadArgument, match=r"plan: expected one along the table"):
        DragController(still, hand)
    with pytest.raises(BadArgument, match=r"plan: expected a positive one, got a force of -1 N"):
        DragController(dataclasses.replace(plan, force=-1.0), hand)
    none = dataclasses.replace(plan, presses=torch.zeros(3, dtype=torch.bool))
    with pytest.raises(BadArgument, match=r"plan: .*no finger that presses"):
        DragController(none, hand)
    lost = dataclasses.replace(plan, feet=torch.full((3, 3), torch.nan).double())
    with pytest.raises(BadArgument, match=r"plan: expected a plan of this hand"):
        DragController(lost, hand)


def test_targets_have_the_same_bits_under_any_setting_of_torch():
    world = Springs("allegro")
    observation = world.feel()
    plain = DragController(world.plan, world.hand).step(observation, PERIOD)
    with other_settings():
        again = DragController(world.plan, world.hand).step(observation, PERIOD)
    assert torch.equal(plain.joints, again.joints) and torch.equal(plain.palm, again.palm)
    # a plan in single precision gives nearly the same
    single = DragController(world.plan.to(torch.float32), world.hand).step(observation, PERIOD)
    near(single.palm, plain.palm, 1e-6)
    turn = inverse(world.plan.obj_from_hand)[:3, :3]
    near(plain.palm, (DRAGGING.height - DRAGGING.fastest * PERIOD) * (turn @ UP), 1e-9)


def test_an_observation_of_another_hand_and_flags_without_forces_are_refused():
    hand, plan, _ = made("allegro")
    controller = DragController(plan, hand)
    four = load_hand("allegro", fingers="four")
    other = observe(four, (four.lower + four.upper) / 2, no_contact(fingers=4))
    with pytest.raises(BadArgument, match=r"observation: .*3 fingertips"):
        controller.step(other, PERIOD)
    flags = feel_flags(no_contact(), torch.tensor([True, True, True]))
    with pytest.raises(BadArgument, match="feel_flags"):
        controller.step(observe(hand, plan.joints, flags), PERIOD)
    before = controller.height
    controller.step(observe(hand, plan.joints, no_contact()), PERIOD)
    assert controller.height < before
