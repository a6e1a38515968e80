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
from torchgrasp.planner.request import Request

GIVEN = {"cloud", "hand", "spec", "starts", "seed"}
OPTIONS = {f.name: f.default for f in dataclasses.fields(Request) if f.name not in GIVEN}
OF_PLANS = {"mode", "ranking", "time_budget", "shape", "observer"}
"""Options that make no sense for all things of a scene."""
FUNCTIONS = (plan_grasps, stream_grasps, explain_empty, plan_scene)


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_a_signature_is_plain_and_has_every_option_with_the_default_of_the_request(function):
    assert "__signature__" not in vars(function)
    shown = inspect.signature(function).parameters
    named = {name: one for name, one in shown.items() if one.kind is one.KEYWORD_ONLY}
    wanted = OPTIONS.keys() - (OF_PLANS if function is plan_scene else set())
    assert wanted == named.keys() - {"workers", "enough", "target"}
    assert all(named[name].default == OPTIONS[name] for name in wanted)
    assert not any(one.kind is one.VAR_KEYWORD for one in shown.values())


def test_every_option_is_explained_and_the_first_screen_of_help_shows_a_call():
    text = pydoc.plain(pydoc.render_doc(plan_grasps))
    assert all(
        re.search(rf"^ +(\w+, )*{name}[:,]", text, re.MULTILINE)
        for name in inspect.signature(plan_grasps).parameters
    )
    screen = "\n".join(text.splitlines()[:24])
    assert (
        ">>> grasps = plan_grasps(" in screen and "hand:" in screen and len(text.splitlines()) <= 70
    )


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda f: f.__name__)
def test_a_misspelt_option_is_told_with_the_options_that_exist(function):
    seen = load_scene() if function is plan_scene else load_object("jug").view
    with pytest.raises(
        TypeError, match=r"unexpected keyword argument 'finger': expected one of .*fingers"
    ):
        function(seen, load_hand("barrett"), finger=4)
