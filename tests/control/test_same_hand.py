"""Grasps are closed by the hand of their plan: a hand of another geometry is refused."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch

from torchgrasp import load_hand
from torchgrasp.control.finger_forces import squeeze
from torchgrasp.control.reference import ClosingReference
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument, Status
from torchgrasp.hand.load import find_hand
from torchgrasp.values.planning import Grasps


@pytest.fixture
def grasp() -> Grasps:
    return load_shipped_grasp("jug", "allegro")


def changed(folder: Path, file: str, before: str, after: str) -> Path:
    """The files of the Allegro hand, with each occurrence of a text replaced in one of them."""
    shutil.copytree(find_hand("allegro"), folder)
    text = (folder / file).read_text()
    assert before in text
    (folder / file).write_text(text.replace(before, after))
    return folder


TIP = '<origin xyz="0 0 0.0267"/>'  # of the fingertips in the last links [m]


@pytest.mark.parametrize("use", [squeeze, ClosingReference.from_grasp])
def test_a_hand_whose_fingers_have_become_longer_is_refused(tmp_path, grasp, use):
    longer = TIP.replace("0.0267", "0.0307")
    hand = load_hand(changed(tmp_path / "allegro", "hand.urdf", TIP, longer))
    with pytest.raises(BadArgument, match=r"hand: .*planned, got allegro, .* up to 4 mm off"):
        use(hand, grasp)


def test_another_stiffness_and_a_change_below_the_bound_are_no_other_geometry(tmp_path, grasp):
    softer = load_hand(changed(tmp_path / "softer", "hand.toml", "kp = 3.0", "kp = 2.0"))
    rounded = TIP.replace("0.0267", "0.0268")
    finer = load_hand(changed(tmp_path / "finer", "hand.urdf", TIP, rounded))
    for hand in (softer, finer):
        assert hand.source.sha256 != grasp.meta["hand_sha256"]
        reference = ClosingReference.from_grasp(hand, grasp)
        assert torch.equal(reference.joints, grasp.joints[0].double())


def test_a_grasp_that_failed_a_check_has_no_closing_plan(grasp):
    failed = dataclasses.replace(grasp, status=torch.tensor([int(Status.TABLE_COLLISION)]))
    with pytest.raises(BadArgument, match=r"grasps: .*grasps\.best, got .*1 TABLE_COLLISION"):
        ClosingReference.from_grasp(load_hand("allegro"), failed)


@pytest.mark.parametrize("use", [squeeze, ClosingReference.from_grasp])
def test_contacts_that_fit_no_fingertip_are_refused(grasp, use):
    hand = load_hand("allegro")
    contacts = grasp.contacts
    wrong = {
        "normals: .* outward": {"normals": -contacts.normals},
        "normals: .* unit": {"normals": 2.0 * contacts.normals},
        "contacts": {"points": 1000.0 * contacts.points},
    }
    for match, change in wrong.items():
        changed_contacts = dataclasses.replace(contacts, **change)
        with pytest.raises(BadArgument, match=match):
            use(hand, dataclasses.replace(grasp, contacts=changed_contacts))
