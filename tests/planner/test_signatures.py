"""What an editor, `help` and a misspelt option show of the planner's entry points."""

import dataclasses
import inspect
import pydoc
import re

import pytest

from torchgrasp import (
    explain_empty,
    load_hand,
    load_object,
    load_scene,
    plan_grasps,
    plan_scene,
    stream_grasps,
)
from torchgrasp.planner import PlanOptions
from torchgrasp.planner.request import Request, SceneOptions

OPTIONS = {
    plan_grasps: PlanOptions,
    stream_grasps: PlanOptions,
    explain_empty: PlanOptions,
    plan_scene: SceneOptions,
}


@pytest.mark.parametrize("function", OPTIONS, ids=lambda f: f.__name__)
def test_a_signature_names_every_option_with_its_default_in_words_without_modules(function):
    shown = inspect.signature(function).parameters
    known = {f.name: f.default for f in dataclasses.fields(Request)}
    for name in OPTIONS[function].__annotations__:
        assert shown[name].kind is shown[name].KEYWORD_ONLY and shown[name].default == known[name]
    assert not any(one.kind is one.VAR_KEYWORD for one in shown.values())
    text = str(inspect.signature(function))
    assert "torchgrasp." not in text and "typing." not in text and "Range(" not in text
    assert re.search(
        r"hand: Hand.*, spec: ContactSpec \| None = None, starts: int = 1000, seed: int = 0", text
    )


def test_every_option_is_explained_and_the_first_screen_of_help_shows_a_call():
    text = pydoc.plain(pydoc.render_doc(plan_grasps))
    assert all(
        re.search(rf"^ +(\w+, )*{name}[:,]", text, re.MULTILINE)
        for name in inspect.signature(plan_grasps).parameters
    )
    screen = "\n".join(text.splitlines()[:24])
    assert (
        ">>> grasps = plan_grasps(" in screen and "hand:" in screen and len(text.splitlines()) <= 55
    )


@pytest.mark.parametrize("function", OPTIONS, ids=lambda f: f.__name__)
def test_a_misspelt_option_is_told_with_the_options_that_exist(function):
    seen = load_scene() if function is plan_scene else load_object("jug").view
    with pytest.raises(
        TypeError, match=r"unexpected keyword argument 'finger': expected one of .*fingers"
    ):
        function(seen, load_hand("barrett"), finger=4)
