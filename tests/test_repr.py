"""The text of values: short, whatever they hold, and true."""

import dataclasses

import torch

from tests.pinch import pinch
from torchgrasp import ContactSpec, load_object
from torchgrasp.base import Value


def test_the_text_of_a_large_value_has_shapes_in_at_most_12_lines():
    hand, grasp = pinch("allegro")
    grasps = grasp[[0] * 200]
    for value in (grasps, hand, load_object("jug").view):
        text = repr(value)
        assert len(text.splitlines()) <= 12 and max(map(len, text.splitlines())) <= 110
    assert "joints=float64[200, 12]" in repr(grasps).replace("\n    ", " ")
    assert repr(grasps).endswith(")") and repr(hand).startswith("Hand(name='allegro'")


def test_few_numbers_are_shown_themselves():
    cloud = load_object("jug").view
    assert cloud.viewpoint is not None
    shown = ", ".join(f"{x:.5g}" for x in cloud.viewpoint.tolist())
    assert f"viewpoint=[{shown}]" in repr(cloud).replace("\n    ", " ")
    assert "friction=0.8" in repr(ContactSpec())


def test_a_value_of_too_many_fields_is_cut():
    names = [f"a_field_of_a_long_name_{k}" for k in range(60)]
    Wide = dataclasses.make_dataclass("Wide", [(name, torch.Tensor) for name in names], bases=(Value,), frozen=True)
    text = repr(Wide(*(torch.zeros(9) for _ in names)))
    assert len(text.splitlines()) == 12 and text.endswith("...)")
