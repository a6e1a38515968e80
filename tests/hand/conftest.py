"""A toy hand of three one-joint fingers, written to a folder that a test may break."""

from pathlib import Path

import pytest

BALL = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
BODY = '<inertial><mass value="0.1"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial>'


@pytest.fixture
def toy_hand(tmp_path: Path) -> Path:
    links = "".join(f'<link name="{n}">{BODY}{BALL}</link>' for n in ("palm", "t1", "t2", "t3"))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="palm"/><child link="t{k}"/>'
        f'<origin xyz="0.0{k} 0 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for k in (1, 2, 3)
    )
    fingers = "".join(
        f'\n[[finger]]\nname = "f{k}"\njoints = ["j{k}"]\ntip_link = "t{k}"\ncontact = [0, 0, 0.1]\n'
        'normal = [0, 0, 1]\ntip = "point"\n'
        for k in (1, 2, 3)
    )
    folder = tmp_path / "toy"
    folder.mkdir()
    (folder / "hand.urdf").write_text(f'<robot name="toy">{links}{joints}</robot>')
    (folder / "hand.toml").write_text(
        'name = "toy"\nurdf = "hand.urdf"\nbase_link = "palm"\napproach = [0, 0, 1]\nlimit_margin = 0.0\n'
        '[actuators]\nkp = 1.0\nkd = 0.1\n[options.default]\nfingers = ["f1", "f2", "f3"]\n' + fingers
    )
    return folder
