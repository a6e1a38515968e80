"""Four fingertips from the cloud to the held object, and the choice of fingers."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from tests.make import closure_margin, load_hand, same_bits
from tests.pinch import QUICK
from torchgrasp import (
    ContactSpec,
    TrialSpec,
    close_hand,
    closing_gains,
    load_grasps,
    load_object,
    load_scene,
    plan_grasps,
    plan_scene,
)
from torchgrasp.app import cli
from torchgrasp.data.shipped import DATA
from torchgrasp.export import format_grasps
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import apply
from torchgrasp.hand import hand_of
from torchgrasp.planner.ranking import expected_success
from torchgrasp.planner.request import finger_sets

pytestmark = pytest.mark.usefixtures("few_postures")
SPEC = ContactSpec(table=0.0)
ALL = ("index", "middle", "ring", "thumb")


@pytest.fixture(scope="module")
def grasps():
    """Grasps of the shipped cylinder with all fingers of the Allegro."""
    return plan_grasps(
        load_object("cylinder").view, load_hand("allegro"), SPEC, starts=20, fingers=4
    )


def test_four_fingers_touch_their_contacts_and_close(grasps):
    hand = hand_of(grasps)
    good = grasps.executable
    assert hand.finger_names == ALL and grasps.meta["finger_names"] == ",".join(ALL)
    assert len(good) >= 4 and good.contacts.points.shape[1:] == (4, 3)
    assert bool((good.success > 0.5).any())
    tips = apply(good.obj_from_hand, hand.tip_centres(good.joints))
    wanted = good.contacts.points + hand.tips.radius[:, None] * good.contacts.normals
    assert float((tips - wanted).norm(dim=-1).max()) < 1e-3
    assert bool((hand.self_clearance(good.joints) >= 0).all()) and bool(
        (hand.self_clearance(good.pregrasp) >= 0).all()
    )
    assert bool((good.permutation.sort(1).values == torch.arange(4)).all())
    for grasp in good:
        margin, rank = closure_margin(
            grasp.contacts.points[0], grasp.contacts.normals[0], SPEC.planned_friction
        )
        assert margin > 1e-8 and rank == 6


def test_files_keep_the_fingers_and_forces_of_four_balance(grasps, tmp_path):
    grasps.save(tmp_path / "four.safetensors")
    read = load_grasps(tmp_path / "four.safetensors")
    assert same_bits(read, grasps)
    names = load_hand("allegro", 4).joint_names
    assert hand_of(read).joint_names == hand_of(read, load_hand("allegro")).joint_names == names
    content = json.loads(format_grasps(hand_of(grasps), grasps[:5], 4.0))
    for row in content["grasps"]:
        assert [contact["finger"] for contact in row["contacts"]] == list(ALL)
        points, normals, forces = (
            np.array([c[key] for c in row["contacts"]]) for key in ("point", "normal", "force")
        )
        push = -(forces * normals).sum(1)
        assert push.min() > 0 and push.max() == pytest.approx(4.0, rel=1e-6)
        np.testing.assert_allclose(forces.sum(0), 0, atol=1e-6)
        np.testing.assert_allclose(np.cross(points, forces).sum(0), 0, atol=1e-7)


def test_another_hand_or_other_fingers_are_refused_by_name(grasps):
    with pytest.raises(BadArgument, match=r"hand_of.*index, middle, ring, thumb"):
        closing_gains(grasps[0], load_hand("allegro"))
    with pytest.raises(BadArgument, match=r"hand: expected allegro.*got barrett"):
        closing_gains(grasps[0], load_hand("barrett"))
    nameless = dataclasses.replace(grasps, meta={})
    with pytest.raises(BadArgument, match="4 contacts"):
        closing_gains(nameless[0], load_hand("allegro"))
    with pytest.raises(BadArgument, match="without a hand"):
        hand_of(nameless)
    with pytest.raises(BadArgument, match="hand: expected allegro"):
        hand_of(grasps, "barrett")
    for fingers, mode in ((4, "paper"), (4, "contact_first"), ("auto", "paper")):
        with pytest.raises(BadArgument, match="mode"):
            plan_grasps(
                load_object("cylinder").view, load_hand("allegro"), fingers=fingers, mode=mode
            )
    for spec, word in (
        (TrialSpec(closing="paper"), "closing"),
        (TrialSpec(holding="impedance"), "holding"),
    ):
        pytest.importorskip("sapien")
        with pytest.raises(BadArgument, match=rf"{word}: expected three.*4 fingertips"):
            close_hand(grasps[0], hand_of(grasps), load_object("cylinder").mesh, spec)


def test_auto_takes_the_set_whose_best_grasps_are_likeliest_to_succeed():
    view = load_object("cylinder").view
    hand = load_hand("allegro")
    notes = []
    best = plan_grasps(
        view, hand, SPEC, 6, fingers="auto", observer=lambda *stage: notes.append(stage)
    )
    hands = finger_sets(hand, "auto")
    assert [one.finger_names for one in hands] == [
        hand.finger_names,
        ALL,
        ("index", "middle", "ring"),
    ]
    told = [text for stage, text, _ in notes if stage == "fingers"]
    assert len(told) == 3 and all(
        ", ".join(one.finger_names) in text for one, text in zip(hands, told, strict=True)
    )
    planned = [value for stage, _, value in notes if stage == "fingers"]
    likeliest = max(range(3), key=lambda k: expected_success(planned[k]))
    alone = plan_grasps(view, hands[likeliest], SPEC, 6)
    assert (
        same_bits(best, planned[likeliest])
        and best.meta == alone.meta
        and torch.equal(best.joints, alone.joints)
    )
    stages = [stage for stage, _, _ in notes if stage != "fingers"]
    assert stages == ["shape", "plan", "certify", "query", "refine"]


def test_the_command_grasps_with_the_fingers_asked_for(tmp_path, capsys):
    view = str(DATA / "cylinder" / "view.ply")
    words = ["grasp", view, "--hand", "allegro", "--starts", "6", "--out", str(tmp_path)]
    assert cli.main([*words, "--fingers", "4"]) == 0
    assert load_grasps(tmp_path / "grasps.safetensors").meta["finger_names"] == ",".join(ALL)
    assert "ring" in (tmp_path / "report.html").read_text()
    assert (
        cli.main(
            ["export", str(tmp_path / "grasps.safetensors"), "--out", str(tmp_path / "a.json")]
        )
        == 0
    )
    assert len(json.loads((tmp_path / "a.json").read_text())["grasps"][0]["contacts"]) == 4
    assert cli.main([*words, "--fingers", "index,thumb"]) == 2
    assert "--fingers" in capsys.readouterr().err


def test_a_thing_of_a_scene_is_grasped_with_the_fingers_asked_for(monkeypatch):
    scene = load_scene()
    hand = load_hand("allegro")
    asked = []
    best = plan_scene(scene, hand, starts=6, fingers=4, enough=0.0).things[0]
    assert best.grasps is not None, best.reason
    assert hand_of(best.grasps, hand).finger_names == ALL and best.grasps.joints.shape[1] == 16
    with pytest.raises(BadArgument, match="fingers"):
        plan_scene(scene, hand, fingers=("index", "thumb"))

    def note(cloud, fingers, **_):
        asked.append((cloud.target, fingers))
        raise BadArgument("cloud", "seen", "nothing")

    monkeypatch.setattr("torchgrasp.planner.scene_plan.plan_grasps", note)
    plan_scene(scene, hand, fingers="auto")
    assert sorted(asked) == [(label, "auto") for label in scene.things]


@pytest.mark.sim
def test_four_fingers_hold_the_cylinder(grasps):
    pytest.importorskip("sapien")
    body = load_object("cylinder")
    result = close_hand(grasps[0], hand_of(grasps), body.mesh, QUICK, parts=body.parts)
    assert result.held and sorted(result.contact_order) == [0, 1, 2, 3]
    assert result.forces.shape[1] == 4 and bool((result.forces[-1] > 0.1).all())
