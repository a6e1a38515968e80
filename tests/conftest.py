"""Generators, analytic shapes and small hands that several tests share."""

import gc
import math
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from hypothesis import HealthCheck, settings
from torch import Tensor

from tests import annotations, kept

if TYPE_CHECKING:
    from torchgrasp.values.planning import PointCloud

os.environ.pop(
    "PYTHONDONTWRITEBYTECODE", None
)  # each of many processes would compile the library and the tests anew
sys.dont_write_bytecode = False

annotations.install()
gc.disable()  # until all tests are collected: hardly any of what that makes is garbage

collect_ignore = [
    "app/agent_client.py",
    "app/software_camera.py",
    "data/lerobot_plugin.py",
    "export/play_newton.py",
]  # their packages are in environments beside, where tests run them

SLOW = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
settings.register_profile(
    "short", max_examples=40, derandomize=True, deadline=None, suppress_health_check=SLOW
)
settings.register_profile(
    "long", max_examples=100_000, deadline=None, database=None, suppress_health_check=SLOW
)
settings.load_profile("short")  # `--hypothesis-profile=long` chooses the other


SIMULATED = re.compile(
    r"\b(close_hand|drag_object|evaluate|drop|lift_from_edge|lift_grasps?|open_scene|pull_grasp|"
    r"run_protocol|open)\("
)
"""What an example calls that opens a simulator."""


def pytest_configure(config: pytest.Config) -> None:
    """Give its fixtures to the examples of the library, which are not below this folder."""
    config.pluginmanager.register(kept)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the examples of docstrings that simulate, as tests that do are marked."""
    for item in items:
        if isinstance(item, pytest.DoctestItem) and item.dtest is not None:
            if any(SIMULATED.search(example.source) for example in item.dtest.examples):
                item.add_marker(pytest.mark.sim)


GARBAGE = (50_000, 10, 10)
"""Thresholds of the collector of garbage: a plan makes many objects and hardly a cycle."""


def pytest_collection_finish() -> None:
    """Take what lives until the end, libraries and tests, out of what the collector looks at."""
    gc.freeze()
    gc.set_threshold(*GARBAGE)
    gc.enable()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Check annotations of the first calls of the next test, too."""
    annotations.check_anew()


SHARING = {"arm", "campaign", "evaluation", "export", "ros2"}
"""Folders whose subject is neither shapes nor plans."""


@pytest.fixture(scope="module", autouse=True)
def shapes_once(request: pytest.FixtureRequest) -> None:
    """Estimate the shape of each object, and draw the library of each hand, once in such folders."""
    if request.path.parent.name in SHARING:
        request.getfixturevalue("kept")


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def motion(generator: torch.Generator) -> Tensor:
    """A rigid motion far from the identity."""
    from torchgrasp.geometry.frames import rigid, rotation_from_vector

    turn = rotation_from_vector(torch.randn(3, generator=generator, dtype=torch.float64))
    return rigid(turn, torch.randn(3, generator=generator, dtype=torch.float64))


@pytest.fixture(scope="session")
def seen_cylinder() -> "PointCloud":
    """One side of a standing cylinder, r 30 mm and h 120 mm, seen from a camera 0.5 m away, with
    exact normals.
    """
    from torchgrasp.values.planning import PointCloud

    rng = torch.Generator().manual_seed(1)
    camera = torch.tensor([0.45, 0.0, 0.3], dtype=torch.float64)
    angle = (torch.rand(1200, generator=rng, dtype=torch.float64) - 0.5) * math.pi * 0.94
    height = torch.rand(1200, generator=rng, dtype=torch.float64) * 0.12
    side_normals = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1)
    side = 0.03 * side_normals + torch.tensor([0.0, 0, 1], dtype=torch.float64) * height[:, None]
    radius = 0.03 * torch.rand(200, generator=rng, dtype=torch.float64).sqrt()
    turn = torch.rand(200, generator=rng, dtype=torch.float64) * 2 * math.pi
    top = torch.stack([radius * turn.cos(), radius * turn.sin(), torch.full_like(turn, 0.12)], -1)
    top_normals = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(200, 3)
    points = torch.cat([side, top])
    normals = torch.cat([side_normals, top_normals])
    seen = ((camera - points) * normals).sum(-1) > 0
    return PointCloud(points[seen], normals[seen], camera)


@pytest.fixture
def few_postures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw libraries of few postures: those of four fingers cost more than the rest of a plan."""
    from torchgrasp.ik.seeds import SeedNumbers

    few = SeedNumbers(postures=2000, many_postures=3000)
    monkeypatch.setattr("torchgrasp.ik.seeds.SEEDS", few)


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
        '[actuators]\nkp = 1.0\nkd = 0.1\n[options.default]\nfingers = ["f1", "f2", "f3"]\n'
        + fingers
    )
    return folder


def box(size: str, xyz: str) -> str:
    return f'<collision><origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry></collision>'


def body(mass: float, inertia: float, com: str, shapes: str) -> str:
    tensor = f'ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0" izz="{inertia}"'
    return f'<inertial><origin xyz="{com}"/><mass value="{mass}"/><inertia {tensor}/></inertial>{shapes}'


def claw_urdf() -> str:
    """Three fingers, two against one: each swivels and bends, and its last joint follows by -0.7
    times plus 0.1.
    """
    parts = [f'<link name="base">{body(0.3, 3e-4, "0 0 0", box("0.11 0.1 0.03", "0 0 0"))}</link>']
    for name, x, y, yaw in (
        ("left", -0.045, -0.03, 0.0),
        ("right", -0.045, 0.03, 0.0),
        ("thumb", 0.045, 0.0, 3.14159265),
    ):
        tip = '<collision><geometry><sphere radius="0.011"/></geometry></collision>'
        links = {
            "root": body(0.02, 2e-6, "0 0 0", box("0.018 0.018 0.014", "0 0 0.009")),
            "near": body(0.04, 2e-5, "0 0 0.03", box("0.016 0.02 0.056", "0 0 0.03")),
            "far": body(0.02, 6e-6, "0 0 0.02", box("0.014 0.018 0.04", "0 0 0.022")),
            "tip": body(0.005, 3e-7, "0 0 0", tip),
        }
        parts += [f'<link name="{name}_{k}">{v}</link>' for k, v in links.items()]
        limit = '<limit lower="{}" upper="{}" effort="1.5" velocity="3"/>'
        swivel = limit.format(-0.5, 0.5)
        bend = limit.format(-0.5, 1.3)
        follow = limit.format(-0.9, 0.5)
        mimic = f'<mimic joint="{name}_bend" multiplier="-0.7" offset="0.1"/>'
        for joint, parent, child, origin, axis, rest in (
            (
                "swivel",
                "base",
                f"{name}_root",
                f'xyz="{x} {y} 0.015" rpy="0 0 {yaw}"',
                "0 0 1",
                swivel,
            ),
            ("bend", f"{name}_root", f"{name}_near", 'xyz="0 0 0.018"', "0 1 0", bend),
            ("follow", f"{name}_near", f"{name}_far", 'xyz="0 0 0.06"', "0 -1 0", follow + mimic),
        ):
            parts.append(
                f'<joint name="{name}_{joint}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
                f'<origin {origin}/><axis xyz="{axis}"/>{rest}</joint>'
            )
        parts.append(
            f'<joint name="{name}_end" type="fixed"><parent link="{name}_far"/><child link="{name}_tip"/>'
            '<origin xyz="0 0 0.048"/></joint>'
        )
    return f'<robot name="claw">{"".join(parts)}</robot>'


@pytest.fixture
def claw(tmp_path: Path) -> Path:
    """The URDF of a hand with three fingers and a coupling unlike the shipped hands', in a folder
    of its own.
    """
    folder = tmp_path / "claw"
    folder.mkdir()
    (folder / "claw.urdf").write_text(claw_urdf())
    return folder / "claw.urdf"
