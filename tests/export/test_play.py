"""Exported folders play in other simulators, with the verdict of our own trial of the same motion."""

import ast
import dataclasses
import functools
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import types
import xml.etree.ElementTree as ET
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import ConvexHull

from tests.export.players import LEAST_SAME, PLAYERS, ROOT, play_all
from torchgrasp import close_hand, fit_shape, load_hand, load_object
from torchgrasp.app import cli
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.export import save_play
from torchgrasp.export.play import pressing_force
from torchgrasp.foundation.errors import BadArgument, MeshError, NoEffect
from torchgrasp.geometry.frames import rigid, rotation_from_vector
from torchgrasp.geometry.plane import Plane, move
from torchgrasp.shape import extract_surface
from torchgrasp.values.specs import TrialSpec

CASES = (
    ("jug", "allegro", 4.0),
    ("jug", "barrett", 4.0),
    ("cylinder", "allegro", 0.25),
)
"""Objects, hands and masses [kg] whose shipped grasps are played: the first is too heavy."""
SPEC = TrialSpec(approach=0.05, hold_time=0.1)
LIBRARIES = {
    "mujoco": {"mujoco", "numpy"},
    "maniskill": {"gymnasium", "environment", "numpy"},
    "newton": {"newton", "warp", "numpy"},
    "isaaclab": {"isaaclab", "numpy", "torch"},
    "usd": {"pxr"},
}
"""What each script imports beside Python's own modules; "environment" is a file of the folder."""

ISAAC_LAB = {
    "SimulationCfg": {"dt", "gravity", "device"},
    "RigidBodyMaterialCfg": {
        "static_friction",
        "dynamic_friction",
        "restitution",
        "friction_combine_mode",
    },
    "CuboidCfg": {"size", "collision_props", "physics_material", "rigid_props", "mass_props"},
    "CollisionPropertiesCfg": {"collision_enabled", "contact_offset", "rest_offset"},
    "ArticulationRootPropertiesCfg": {
        "fix_root_link",
        "enabled_self_collisions",
        "articulation_enabled",
    },
    "UsdFileCfg": {"usd_path", "articulation_props", "rigid_props", "scale", "variants"},
    "ImplicitActuatorCfg": {
        "joint_names_expr",
        "stiffness",
        "damping",
        "effort_limit_sim",
        "armature",
        "friction",
    },
    "ArticulationCfg": {"prim_path", "spawn", "init_state", "actuators"},
    "InitialStateCfg": {"pos", "rot", "joint_pos", "joint_vel"},
    "RigidObjectCfg": {"prim_path", "spawn", "init_state"},
}
"""Fields of Isaac Lab's configurations that its documentation of version 2.3.2 lists."""


def spec_of(mass):
    spec = dataclasses.replace(SPEC, mass=mass)
    return dataclasses.replace(spec, force=pressing_force(spec, mass))


def export(folder, player, name, hand, mass):
    thing = load_object(name)
    grasp = load_shipped_grasp(name, hand)
    return save_play(
        load_hand(hand), grasp, folder, player, thing.mesh, spec_of(mass), parts=thing.parts
    )


@functools.cache
def own_verdict(name, hand, mass):
    """Return whether our trial of the same motion lifts the object by half of the lift."""
    thing = load_object(name)
    trial = dataclasses.replace(spec_of(mass), closing="open_loop", simulator="mujoco")
    grasp = load_shipped_grasp(name, hand)
    found = close_hand(grasp, hand, thing.mesh, trial, parts=thing.parts)
    return found.rise >= 0.5 * trial.lift_height


def beside(environment):
    """Return the Python of a simulator's environment."""
    python = ROOT / environment / "bin" / "python"
    if not python.exists():
        pytest.skip(f"scripts/beside makes {environment}")
    return python


def export_cases(place, player):
    """Export all cases; the first needs more force than the drives exert, which is told."""
    with pytest.warns(NoEffect, match="N are exerted"):
        return [export(place / "_".join(map(str, case)), player, *case) for case in CASES]


@pytest.fixture(scope="module")
def in_newton(tmp_path_factory):
    """Return the folder of a scene in USD, a scene in MJCF, and what Newton found in both: its
    libraries are loaded once.
    """
    python = beside(".beside/newton")
    place = tmp_path_factory.mktemp("newton")
    usd = export(place / "usd", "usd", "jug", "barrett", 0.25)
    scenes = export_cases(place, "newton")
    script = str(Path(__file__).with_name("play_newton.py"))
    words = [str(python), "-W", "ignore", script, str(usd), *map(str, scenes)]
    done = subprocess.run(
        words, capture_output=True, text=True, check=False, env={**os.environ, "PYTHONPATH": ""}
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    played = [json.loads(x)["held"] for x in done.stdout.splitlines() if '"held"' in x]
    return usd, scenes[-1], found | {"held": played}


def check_verdicts(played):
    """Assert that a simulator's verdicts are ours; some are held and some are not."""
    own = [own_verdict(*case) for case in CASES]
    same = sum(one == other for one, other in zip(played, own, strict=True))
    assert same >= LEAST_SAME * len(own)
    assert 0 < sum(own) < len(own)


@pytest.mark.sim
@pytest.mark.parametrize("name", [name for name in PLAYERS if name != "Newton"])
def test_a_simulator_has_the_verdict_of_our_trial(name, tmp_path):
    player, environment = PLAYERS[name]
    beside(environment)
    check_verdicts(play_all(environment, export_cases(tmp_path, player)))


@pytest.mark.sim
def test_newton_has_the_verdict_of_our_trial(in_newton):
    *_, found = in_newton
    check_verdicts(found["held"])


@pytest.mark.parametrize("player", LIBRARIES)
def test_a_script_is_short_and_needs_the_simulator_and_numpy(player, tmp_path):
    folder = export(tmp_path, player, "jug", "barrett", 0.25)
    text = (folder / "play.py").read_text()
    modules = {x.module for x in ast.walk(ast.parse(text)) if isinstance(x, ast.ImportFrom)}
    modules |= {
        name.name
        for x in ast.walk(ast.parse(text))
        if isinstance(x, ast.Import)
        for name in x.names
    }
    assert len(text.splitlines()) <= 70 and max(map(len, text.splitlines())) <= 120
    # one statement on a line
    statements = [x.lineno for x in ast.walk(ast.parse(text)) if isinstance(x, ast.stmt)]
    assert len(set(statements)) == len(statements)
    assert {x.split(".")[0] for x in modules} - sys.stdlib_module_names == LIBRARIES[player]


@pytest.mark.parametrize(
    ("player", "word"), [*((name, "99") for name in LIBRARIES), ("mujoco", "-1"), ("usd", "one")]
)
def test_a_script_refuses_a_grasp_that_it_has_not(player, word, tmp_path, monkeypatch):
    """The simulators are stand-ins, on which a script that goes on fails with another error."""
    folder = export(tmp_path, player, "jug", "barrett", 0.25)
    play = types.SimpleNamespace(
        PLAY=json.loads((folder / "play.json").read_text()), DRIVES=(), RATE=1
    )
    for name in LIBRARIES[player] - {"numpy", "torch"} | {
        "isaaclab.app",
        "isaaclab.sim",
        "isaaclab.actuators",
    }:
        monkeypatch.setitem(sys.modules, name, play if name == "environment" else MagicMock())
    monkeypatch.setitem(sys.modules, "isaaclab.assets", MagicMock())
    monkeypatch.setattr(sys, "argv", ["play.py", word])
    with pytest.raises(
        SystemExit, match=rf"^expected .* from 0 to 0, got {word}$"
    ):  # Python prints it; the code is 1
        runpy.run_path(str(folder / "play.py"), run_name="__main__")


@pytest.mark.parametrize("player", LIBRARIES)
def test_a_script_has_help_without_its_simulator(player, tmp_path):
    folder = export(tmp_path, player, "jug", "barrett", 0.25)
    # isolated: no package at all is found
    words = [sys.executable, "-I", "-S", str(folder / "play.py"), "--help"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("usage: play.py [-h]") and "from 0, the best" in done.stdout
    assert ("--view" in done.stdout) == (player in ("mujoco", "isaaclab"))


def test_mujoco_shows_the_motion_in_its_passive_viewer(tmp_path, monkeypatch, capsys):
    """A stand-in of the viewer sees the object rise by what is printed, in each grasp."""
    pytest.importorskip("mujoco")
    folder = export(tmp_path, "mujoco", "jug", "barrett", 0.25)
    seen = []

    class Viewer:
        """Is open until the object was seen after the motion, as if the user then closed it."""

        def __init__(self, model, data):
            self.data = data
            self.left = 3

        def __enter__(self):
            seen.append([])
            return self

        def __exit__(self, *error):
            seen[-1].append(float(self.data.body("torchgrasp_object").xipos[2]))

        def is_running(self):
            self.left -= self.data.time >= play["times"]["hold"]
            return self.left > 0

        def sync(self):
            seen[-1].append(float(self.data.body("torchgrasp_object").xipos[2]))

    play = json.loads((folder / "play.json").read_text())
    viewer = types.SimpleNamespace(launch_passive=Viewer)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", viewer)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr(sys, "argv", ["play.py", "0", "--view"])
    runpy.run_path(str(folder / "play.py"), run_name="__main__")
    told = json.loads(capsys.readouterr().out)
    (heights,) = seen
    # 60 pictures each second of the motion
    assert len(heights) == pytest.approx(60 * play["times"]["hold"], rel=0.1)
    assert told["held"] and heights[-1] - heights[0] == pytest.approx(told["rise"], abs=1e-4)


def test_isaac_lab_gets_fields_that_its_documentation_lists(tmp_path):
    tree = ast.parse((export(tmp_path, "isaaclab", "jug", "barrett", 0.25) / "play.py").read_text())
    calls = [
        (getattr(x.func, "attr", getattr(x.func, "id", "")), x)
        for x in ast.walk(tree)
        if isinstance(x, ast.Call)
    ]
    made = {
        name: {word.arg for word in call.keywords if word.arg}
        for name, call in calls
        if name.endswith("Cfg")
    }
    assert made.keys() == ISAAC_LAB.keys() and all(made[name] <= ISAAC_LAB[name] for name in made)


@pytest.mark.sim
def test_a_scene_in_usd_is_valid_and_plays_in_newton(in_newton):
    """OpenUSD reads every body, joint and drive; Newton's reader builds a scene in which the jug is
    lifted.
    """
    folder, _, found = in_newton
    hand = load_hand("barrett")
    assert found["valid"] and found["rise"] > 0.5 * SPEC.lift_height
    play = json.loads((folder / "play.json").read_text())
    assert found["mass"] == pytest.approx(play["object"]["mass"])
    for name, drive in hand.actuators.items():
        joint = found["joints"][name]
        assert [joint["kp"], joint["kd"], joint["effort"]] == pytest.approx(
            [drive.kp, drive.kd, drive.effort], rel=1e-5
        )
    assert (folder / "motion_0.usda").is_file()


@pytest.mark.sim
def test_newton_has_the_iterations_against_slip_of_our_scene(in_newton):
    """Newton's reader of MJCF drops them, so the script sets them on the built model."""
    _, folder, found = in_newton
    scene = ET.parse(folder / "scene.xml").find("option")
    assert found["iterations"] == int(scene.get("noslip_iterations")) == 2


def test_the_drives_have_the_effort_limits_of_the_urdf_and_the_gains_of_the_hand(tmp_path):
    hand = load_hand("allegro")
    limits = {
        joint.get("name"): float(joint.find("limit").get("effort"))
        for joint in ET.parse(hand.urdf_path).iter("joint")
        if joint.get("type") == "revolute"
    }
    folder = export(tmp_path, "mujoco", "jug", "allegro", 0.25)
    drives = json.loads((folder / "play.json").read_text())["drives"]
    assert {name: drives[name]["effort"] for name in limits} == limits and list(drives)[3:] == list(
        hand.tree.joint_names
    )
    for servo in ET.parse(folder / "scene.xml").iter("position"):
        name = servo.get("name")
        assert float(servo.get("forcerange").split()[1]) == drives[name]["effort"]
        assert (
            float(servo.get("kp")) == drives[name]["kp"]
            and float(servo.get("kv")) == drives[name]["kd"]
        )
    urdf = ET.parse(export(tmp_path, "maniskill", "jug", "allegro", 0.25) / "hand.urdf")
    efforts = {
        x.get("name"): x.find("limit").get("effort")
        for x in urdf.iter("joint")
        if x.get("name") in limits
    }
    assert {name: float(effort) for name, effort in efforts.items()} == limits


def test_links_and_joints_of_a_hand_may_have_any_name(tmp_path):
    """A link "base" and joints such as "mount_x" and "wrist" are those of many hands."""
    mujoco = pytest.importorskip("mujoco")
    source = load_hand("barrett").urdf_path.parent
    shutil.copytree(source, tmp_path / "hand")
    names = {"palm": "base", "f1_flex": "mount_x", "f2_flex": "wrist"}
    for path in (tmp_path / "hand").glob("hand.*"):
        text = path.read_text()
        for old, new in names.items():
            text = text.replace(f'"{old}"', f'"{new}"')
        path.write_text(text)
    hand = load_hand(tmp_path / "hand")
    assert {"mount_x", "wrist"} <= {*hand.joint_names}
    grasp = load_shipped_grasp("jug", "barrett")
    grasp = dataclasses.replace(
        grasp, meta=grasp.meta | {"joint_names": ",".join(hand.joint_names)}
    )
    thing = load_object("jug")
    for player in ("mujoco", "usd"):
        save_play(hand, grasp, tmp_path / player, player, thing.mesh, SPEC, parts=thing.parts)
    mujoco.MjModel.from_xml_path(str(tmp_path / "mujoco" / "scene.xml"))
    links = re.findall(
        r'^ {4}def Xform "(\w+)"', (tmp_path / "usd" / "hand.usda").read_text(), re.M
    )
    assert "base" in links and len(set(links)) == len(links) > 4


def test_the_motion_leads_from_the_approach_to_the_plan_and_up(tmp_path):
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    play = json.loads(
        (export(tmp_path, "mujoco", "jug", "barrett", 0.25) / "play.json").read_text()
    )
    assert list(play["times"]) == ["approach", "pregrasp", "grasp", "squeeze", "lift", "hold"]
    assert all(np.diff(list(play["times"].values())) > 0)
    (row,) = play["grasps"]
    planned = {name: float(q) for name, q in hand.expand(grasp.joints[0]).items()}
    targets = {
        phase: np.array([posture[f"torchgrasp_mount_{x}"] for x in "xyz"])
        for phase, posture in row["targets"].items()
    }
    assert {name: row["targets"]["grasp"][name] for name in planned} == pytest.approx(planned)
    rotation = grasp.obj_from_hand[0, :3, :3].double().numpy()
    assert rotation @ targets["lift"] == pytest.approx([0, 0, SPEC.lift_height])
    assert rotation @ (targets["pregrasp"] - targets["approach"]) == pytest.approx(
        SPEC.approach * grasp.approach[0].double().numpy(), abs=1e-6
    )


def test_a_tilted_table_is_level_in_the_folder(tmp_path):
    """Everything is turned by an angle; the folder's object stands as that of the scene which was
    not turned.
    """
    thing = load_object("jug")
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    turn = rigid(
        rotation_from_vector(torch.tensor([0.4, -0.2, 0.3], dtype=torch.float64)),
        torch.full((3,), 0.1).double(),
    )
    table = Plane.horizontal(0.0).moved(turn)
    meta = grasp.meta | {"table": table.describe()}
    moved = dataclasses.replace(move(grasp.to(torch.float64), turn), meta=meta)
    mesh = thing.mesh.copy().apply_transform(turn.numpy())
    save_play(hand, moved, tmp_path, "mujoco", mesh, SPEC, parts=[mesh.convex_hull])
    play = json.loads((tmp_path / "play.json").read_text())
    solid = trimesh.load(tmp_path / "object.ply")
    assert play["table_height"] == pytest.approx(0.0, abs=1e-5) and solid.bounds[
        0, 2
    ] == pytest.approx(0.0, abs=1e-5)
    assert play["grasps"][0]["position"][2] == pytest.approx(
        float(grasp.obj_from_hand[0, 2, 3]), abs=1e-5
    )
    assert play["object"]["centre"][2] == pytest.approx(float(thing.mesh.center_mass[2]), abs=1e-5)


def test_mujoco_plays_on_a_table_that_ends_and_other_players_refuse_it(tmp_path):
    import mujoco

    thing = load_object("jug")
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    turn = rigid(
        rotation_from_vector(torch.tensor([0.4, -0.2, 0.3], dtype=torch.float64)),
        torch.full((3,), 0.1).double(),
    )
    point, outward = torch.tensor([[0.02, 0.0, 0.0], [1.0, 0.5, 0.0]], dtype=torch.float64)
    table = Plane.horizontal(0.0).ending(point, outward).moved(turn)
    moved = move(grasp.to(torch.float64), turn)
    moved = dataclasses.replace(moved, meta=grasp.meta | {"table": table.describe()})
    mesh = thing.mesh.copy().apply_transform(turn.numpy())
    for player in LIBRARIES.keys() - {"mujoco"}:
        with pytest.raises(BadArgument, match=r"player: expected .*got .* a table with an edge"):
            save_play(hand, moved, tmp_path, player, mesh, SPEC, parts=[mesh.convex_hull])
    assert not list(tmp_path.iterdir())
    save_play(hand, moved, tmp_path, "mujoco", mesh, SPEC, parts=[mesh.convex_hull])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    top = model.geom("torchgrasp_table").id
    axes = data.geom_xmat[top].reshape(3, 3)
    body = json.loads((tmp_path / "play.json").read_text())["object"]
    # the face of the box in its first direction is as far from the object as the edge
    face = (data.geom_xpos[top] - body["centre"]) @ axes[:, 0] + model.geom_size[top, 0]
    mass_centre = torch.from_numpy(np.array(mesh.center_mass))
    assert face == pytest.approx(-float(table.edge.height(mass_centre)), abs=1e-4)
    assert data.geom_xpos[top, 2] + model.geom_size[top, 2] == pytest.approx(0.0, abs=1e-5)


def test_an_export_that_cannot_play_says_why(tmp_path, capsys):
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("jug", "barrett")
    thing = load_object("jug")
    with pytest.raises(BadArgument, match="at least one grasp"):
        save_play(hand, grasp[:0], tmp_path, "mujoco", thing.mesh)
    with pytest.raises(MeshError):
        save_play(
            hand,
            grasp,
            tmp_path,
            "mujoco",
            trimesh.Trimesh(thing.mesh.vertices, thing.mesh.faces[5:]),
        )
    grasp.save(tmp_path / "grasps.safetensors")
    call = ["export", str(tmp_path / "grasps.safetensors"), "--out", str(tmp_path / "out")]
    assert (
        cli.main([*call, "--format", "play-mujoco"]) == 2 and "--object" in capsys.readouterr().err
    )


def test_the_command_plays_on_the_estimated_surface(tmp_path, capsys):
    words = [
        "grasp",
        "cylinder",
        "--hand",
        "barrett",
        "--starts",
        "8",
        "--out",
        str(tmp_path),
        "--no-report",
    ]
    assert cli.main(words) == 0
    out = tmp_path / "play"
    words = [
        "export",
        str(tmp_path / "grasps.safetensors"),
        "--format",
        "play-newton",
        "--out",
        str(out),
    ]
    assert cli.main(words) == 0 and str(out) in capsys.readouterr().out
    solid = trimesh.load(out / "object.ply")
    assert solid.is_watertight and solid.extents == pytest.approx(
        load_object("cylinder").mesh.extents, abs=0.02
    )
    assert share_of_base(solid) > 0.5


def share_of_base(solid):
    """Return the area of the base over that of the shadow: on a round base a body would rock."""
    base = solid.vertices[solid.vertices[:, 2] < solid.bounds[0, 2] + 1e-6, :2]
    return ConvexHull(base).volume / ConvexHull(solid.vertices[:, :2]).volume


def test_an_estimate_stands_on_the_table_and_a_true_mesh_stays_as_it_is(tmp_path):
    thing = load_object("cylinder")
    hand = load_hand("barrett")
    grasp = load_shipped_grasp("cylinder", "barrett")
    surface = extract_surface(fit_shape(thing.view, table=0.0), 24)
    parts = [thing.mesh.convex_hull]
    low = thing.mesh.copy().apply_translation([0, 0, -0.003])
    found = [
        trimesh.load(
            save_play(hand, grasp, tmp_path / str(k), "mujoco", mesh, SPEC, parts=parts)
            / "object.ply"
        )
        for k, mesh in enumerate((surface, low))
    ]
    assert surface.vertices[:, 2].min() < -1e-4 and found[0].bounds[0, 2] == pytest.approx(
        0.0, abs=1e-6
    )
    assert share_of_base(found[0]) > 0.5
    np.testing.assert_allclose(found[1].bounds, low.bounds, atol=1e-6)


def test_the_parts_of_another_object_in_the_folder_are_not_used(tmp_path):
    for name in ("jug", "cylinder"):
        folder = export(tmp_path, "maniskill", name, "barrett", 0.25)
        mesh = load_object(name).mesh
        files = json.loads((folder / "play.json").read_text())["object"]["files"]
        bounds = trimesh.util.concatenate([trimesh.load(folder / file) for file in files]).bounds
        assert bounds / 100 == pytest.approx(mesh.bounds, abs=1e-3)
    assert (
        len(files) < len(list(folder.glob("*.obj")))
        and "glob" not in (folder / "environment.py").read_text()
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--format", "json", "--mass", "2"], "--mass: expected a format that it is for"),
        (["--format", "glb", "--friction", "0.5"], "--friction: expected a format that it is for"),
        (["--format", "glb", "--out", "jug.ply"], "--out: expected a file ending in .glb"),
        (
            ["--format", "json", "--rename", "spread=a", "spread=b"],
            "--rename: expected each joint once",
        ),
    ],
)
def test_no_option_of_an_export_is_ignored(words, told, tmp_path, capsys):
    load_shipped_grasp("jug", "barrett").save(tmp_path / "grasps.safetensors")
    (tmp_path / "surface.ply").write_bytes(load_object("jug").mesh.export(file_type="ply"))
    out = tmp_path / "out"
    assert (
        cli.main(["export", str(tmp_path / "grasps.safetensors"), "--out", str(out), *words]) == 2
    )
    assert told in capsys.readouterr().err and not out.exists()


def test_a_glb_counts_the_one_grasp_that_it_holds(tmp_path, capsys):
    grasp = load_shipped_grasp("jug", "barrett")
    file = tmp_path / "grasps.safetensors"
    grasp[[0, 0]].save(file)
    (tmp_path / "surface.ply").write_bytes(load_object("jug").mesh.export(file_type="ply"))
    assert (
        cli.main(["export", str(file), "--format", "glb", "--out", str(tmp_path / "jug.glb")]) == 0
    )
    assert capsys.readouterr().out.startswith("1 grasp of")


@pytest.mark.parametrize("name", ["glb", "play-mujoco", "usd", "graspgen", "dexgraspbench"])
def test_an_object_that_is_not_where_the_grasp_is_is_refused(name, tmp_path, capsys):
    load_shipped_grasp("jug", "allegro").save(tmp_path / "grasps.safetensors")
    mesh = load_object("jug").mesh.copy()
    file = tmp_path / "bench" / "mesh" / "simplified.obj"
    file.parent.mkdir(parents=True)
    given = tmp_path / "bench" if name == "dexgraspbench" else file
    call = ["export", str(tmp_path / "grasps.safetensors"), "--format", name]
    call += ["--object", str(given), "--out", str(tmp_path / "out.glb")]
    mesh.export(file)
    if name in ("graspgen", "dexgraspbench", "glb"):  # the others cut the mesh into parts
        assert cli.main([*call[:-1], str(tmp_path / "right.glb")]) == 0
    mesh.apply_translation([0.1, 0.0, 0.0]).export(file)
    assert cli.main(call) == 2
    told = capsys.readouterr().err
    assert "--object: expected contacts of grasps within 10 mm of the mesh's surface" in told
    assert not (tmp_path / "out.glb").exists()


def test_parts_that_are_not_those_of_the_mesh_are_refused(tmp_path):
    thing = load_object("jug")
    away = [part.copy().apply_translation([0.0, 0.1, 0.0]) for part in thing.parts]
    given = load_hand("barrett"), load_shipped_grasp("jug", "barrett"), tmp_path, "mujoco"
    with pytest.raises(MeshError, match=r"parts: .*100 mm off"):
        save_play(*given, thing.mesh, parts=away)
