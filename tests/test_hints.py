"""What Python users are told: the nearest name, the value that has a field, shipped objects by
name.
"""

import pytest
import torch

from torchgrasp import (
    ContactSpec,
    fit_shape,
    load_hand,
    load_object,
    plan_grasps,
)
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.success.task import GraspTask


@pytest.mark.parametrize(
    ("call", "near"),
    [
        (lambda: load_hand("alegro"), "allegro"),
        (lambda: plan_grasps("jug", "baret"), "barrett"),
        (lambda: load_object("jgu"), "jug"),
        (lambda: plan_grasps("jgu", "barrett"), "jug"),
        (lambda: load_hand("allegro", "paper_literl"), "paper_literal"),
        (lambda: plan_grasps("jug", "barrett", mode="joints"), "joint"),
        (lambda: load_hand("allegro", ("index", "midle", "thumb")), None),
        (lambda: load_hand("zzz"), None),
    ],
)
def test_a_misspelt_name_is_answered_with_the_nearest_one(call, near):
    with pytest.raises(BadArgument) as caught:
        call()
    said = str(caught.value)
    assert said.endswith(f"; did you mean {near}?") if near else "did you mean" not in said


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"friction": 0.5}, "friction is a field: spec=ContactSpec(friction=...)"),
        ({"table": 0.0}, "table is a field: spec=ContactSpec(table=...)"),
        ({"mass": 0.2}, "mass is a field: task=GraspTask(mass=...)"),
        ({"start": 5}, "did you mean starts?"),
    ],
)
def test_a_stray_option_is_shown_its_place(options, told):
    with pytest.raises(TypeError) as caught:
        plan_grasps("jug", "barrett", **options)
    assert str(caught.value).endswith(f"; {told}")
    with pytest.raises(TypeError, match=r"did you mean friction\?"):
        ContactSpec(**{"fricton": 0.5})
    # the oracle: each told place takes the option
    assert ContactSpec(friction=0.5, table=0.0).friction == GraspTask(mass=0.5).mass


def test_a_shipped_object_is_taken_by_name_and_a_file_of_that_name_comes_first(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    at = torch.tensor([[0.05, 0.0, 0.05]], dtype=torch.float64)
    by_name = fit_shape("cylinder", seed=0).predict(at).distance
    assert torch.equal(by_name, fit_shape(load_object("cylinder"), seed=0).predict(at).distance)
    (tmp_path / "cylinder").write_text("a file of the same name")
    with pytest.raises(BadArgument, match="got cylinder"):
        fit_shape("cylinder")
    with pytest.raises(
        BadArgument, match=r"a file, or one of the shipped objects .*, got 'pot', which is no file"
    ):
        fit_shape("pot")


def test_a_mode_without_a_model_blames_the_mode_and_the_hand():
    with pytest.raises(BadArgument) as caught:
        plan_grasps("cylinder", "leap", mode="paper", starts=5)
    assert caught.value.argument == "mode" and "the leap hand" in str(caught.value)
