"""The public laws: shipped hands, kernels and simulators obey them, broken ones are told which they
break.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.laws.kernels import check_kernel
from tests.laws.scenes import check_scene
from torchgrasp.foundation.errors import BrokenLaw, HandFileError
from torchgrasp.hand.hand import Hand
from torchgrasp.hand.load import hands_folder
from torchgrasp.shape import Kernel, matern52_kernel, rbf_kernel, thin_plate_kernel
from torchgrasp.shape.kernel import kernel_by_name
from torchgrasp.testing import check_hand


@pytest.mark.promise("N13")
@pytest.mark.parametrize(
    ("name", "fingers"),
    [("allegro", "default"), ("allegro", "paper_literal"), ("barrett", "default")],
)
def test_shipped_hands_obey_the_law(name, fingers):
    assert check_hand(name, fingers).name == name


def copy_of(name: str, tmp_path: Path, file: str, old: str, new: str) -> Path:
    """Copy a shipped hand with the first occurrence of `old` replaced in one of its files."""
    for part in ("hand.urdf", "hand.toml"):
        text = (hands_folder() / name / part).read_text()
        if part == file:
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / part).write_text(text)
    return tmp_path


@pytest.mark.parametrize(
    ("name", "file", "old", "new", "match"),
    [
        ("allegro", "hand.urdf", '<mass value="0.4154"/>', '<mass value="0"/>', "mass"),
        ("allegro", "hand.urdf", 'ixx="0.0007501"', 'ixx="0.0107501"', "principal"),
        ("allegro", "hand.urdf", 'effort="0.7"', 'effort="0"', "effort"),
        ("allegro", "hand.toml", "joint_9 = -0.196", "joint_9 = -1.0", "joint_9"),
        ("barrett", "hand.toml", "ratio = 0.3333333333333333", "ratio = 0.3443", "coupling"),
        (
            "allegro",
            "hand.toml",
            "[0.01039230485, 0, 0.006]",
            "[-0.01039230485, 0, -0.006]",
            "center",
        ),
        (
            "barrett",
            "hand.toml",
            '["f3_flex", "f3_distal"]',
            '["f3_distal", "f3_flex"]',
            "in order",
        ),
        (
            "leap",
            "hand.toml",
            '"10" = -0.2',
            '"10" = -0.5',
            r"meet in all .* as ring_\w+ and ring_",
        ),
    ],
)
def test_broken_hands_are_told_why(tmp_path, name, file, old, new, match):
    with pytest.raises(HandFileError, match=match):
        check_hand(copy_of(name, tmp_path, file, old, new))


@pytest.mark.parametrize(
    ("shape", "depth"),
    [('<box size="0.04 0.02 0.02"/>', 0.02), ('<cylinder radius="0.01" length="0.04"/>', 0.02)],
)
def test_a_contact_inside_its_tip_is_told(tmp_path, shape, depth):
    """A tip 40 mm long, turned by 90 degrees so that it reaches along z; its end is the pad."""
    turn = "0 1.5707963267948966 0" if "box" in shape else "0 0 0"
    text = (hands_folder() / "allegro" / "hand.urdf").read_text()
    start = text.index("<collision>", text.index('<link name="index_tip">'))
    collision = (
        f'<collision><origin xyz="0 0 0" rpy="{turn}"/><geometry>{shape}</geometry></collision>'
    )
    (tmp_path / "hand.urdf").write_text(
        text[:start] + collision + text[text.index("</link>", start) :]
    )
    toml = (hands_folder() / "allegro" / "hand.toml").read_text()
    pad = 'contact = [0.01039230485, 0, 0.006]\nnormal = [0.8660254037844387, 0.0, 0.5]\ntip = "sphere"\n'
    pad += "center = [0, 0, 0]\nradius = 0.012"
    assert pad in toml
    point = 'contact = [0, 0, {}]\nnormal = [0.0, 0.0, 1.0]\ntip = "point"'
    (tmp_path / "hand.toml").write_text(toml.replace(pad, point.format(depth), 1))
    assert check_hand(tmp_path).tips.radius[0] == 0
    (tmp_path / "hand.toml").write_text(toml.replace(pad, point.format(depth - 0.001), 1))
    with pytest.raises(HandFileError, match="inside"):
        check_hand(tmp_path)


def test_a_hand_of_ones_own_is_accepted(tmp_path):
    folder = copy_of("barrett", tmp_path, "hand.toml", 'name = "barrett"', 'name = "mine"')
    assert check_hand(folder).name == "mine"


@pytest.mark.parametrize(
    ("name", "wrong", "law"),
    [
        ("link_poses", lambda x: x + 1e-6, "kinematics"),
        ("jacobian", lambda x: 1.01 * x, "jacobian"),
        ("fingertips", lambda x: (x[0] + 1e-4 * x[0].ndim, x[1]), "batch"),
    ],
)
def test_a_hand_that_moves_otherwise_is_told_which_law_it_breaks(monkeypatch, name, wrong, law):
    right = getattr(Hand, name)
    monkeypatch.setattr(Hand, name, lambda self, joints: wrong(right(self, joints)))
    with pytest.raises(BrokenLaw, match=law):
        check_hand("barrett")


@pytest.mark.promise("N3", "N4")
@pytest.mark.parametrize("name", ["thin_plate", "matern52", "rbf"])
@pytest.mark.parametrize("psi", [0.5, 3.6, 10.0])
def test_shipped_kernels_obey_the_law(name, psi):
    kernel = kernel_by_name(name, psi)
    assert check_kernel(kernel) is kernel


PLATE = thin_plate_kernel(3.6)
BROKEN = {
    "finite": Kernel(lambda r: torch.where(r > 1, torch.nan, torch.exp(-r * r))),
    "variance": Kernel(lambda r: -torch.exp(-r * r)),
    "variance of normals": Kernel(torch.ones_like),
    "smooth": Kernel(lambda r: torch.exp(-r)),
    "derivatives of another": Kernel(
        rbf_kernel(1.0).profile, closed_form=matern52_kernel(1.0).derivatives
    ),
    "derivatives that end at a kink": Kernel(lambda r: torch.clamp(1 - r * r, min=0.0) ** 2),
    "covariance": Kernel(torch.cos),
    "covariance beyond the ball": Kernel(PLATE.profile, closed_form=PLATE.closed_form),
    "covariance of the paper's psi": Kernel(PLATE.profile, 3.6),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_kernel_is_told_which_law_it_breaks(name):
    with pytest.raises(BrokenLaw, match=rf"^{name.split()[0]}: expected .*got") as broken:
        check_kernel(BROKEN[name])
    assert broken.value.law == name.split()[0]


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "wrong", "law"),
    [
        ("joints", lambda scene, x: x + 0.01, "joints"),
        ("tip_poses", lambda scene, x: x[::-1], "kinematics"),
        ("jacobian", lambda scene, x: 2 * x, "kinematics"),
        ("penetration", lambda scene, x: 0.0, "overlap"),
        ("object_pose", lambda scene, x: x + 0.01, "rest"),
        (
            "hand_pose",
            lambda scene, x: x + 0.001 * scene.data.time * (scene.data.time > 0.5),
            "lift",
        ),
        ("object_pose", lambda scene, x: x + 1e-9 * np.random.default_rng().random(), "repeat"),
    ],
)
def test_a_simulator_is_told_which_law_it_breaks(name, wrong, law):
    pytest.importorskip("mujoco")
    from torchgrasp.sim.mujoco_scene import MujocoScene

    right = getattr(MujocoScene, name)
    broken = type("Broken", (MujocoScene,), {name: lambda self, *at: wrong(self, right(self, *at))})
    with pytest.raises(BrokenLaw, match=rf"^{law}: expected .*got"):
        check_scene(broken)
