"""Agents: a client of the official SDK calls `torchgrasp mcp` as a process, by stdio and by HTTP."""

import base64
import contextlib
import dataclasses
import http.client
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.make import halved
from torchgrasp import Distribution, GraspTask, load_grasps, load_object, load_scene
from torchgrasp.app.cli import agent_server
from torchgrasp.app.cli.agent_answers import Answer, ChangeRow, ExplainAnswer, plain_answer
from torchgrasp.app.cli.agent_files import Workplace
from torchgrasp.app.cli.agent_tools import TOOLS, Tool, make_tool
from torchgrasp.data.shipped import DATA, load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument, GraspError
from torchgrasp.hand.load import hands_folder

ROOT = Path(__file__).parents[2]
PYTHON = ROOT / ".beside" / "mcp" / "bin" / "python"
COMMAND = (str(PYTHON), "-m", "torchgrasp", "mcp", "--folder")
FEW = {"starts": 8, "most": 2}
THING = 4
"""The object of the shipped scene that is planned on."""
UNITS = ("[m]", "[rad]", "[kg]", "[s]", "[pixels]", "[degrees]")


def converse(server, calls):
    """Return what a client hears of a server: the words of its command, or its address."""
    if not PYTHON.exists():
        pytest.skip("scripts/beside mcp makes the environment of the SDK")
    asked = [server, [(*call, None)[:3] for call in calls]]
    done = subprocess.run(
        [PYTHON, ROOT / "tests" / "app" / "agent_client.py"],
        input=json.dumps(asked),
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a cloud, a bad cloud, a depth image of half the size, and a link out of it."""
    place = tmp_path_factory.mktemp("agents")
    shutil.copy(DATA / "cylinder" / "view.ply", place / "tin.ply")
    np.save(place / "two.npy", np.random.default_rng(0).normal(size=(2, 3)))
    np.save(place / "mm.npy", np.random.default_rng(0).normal(size=(200, 3)) * 40)
    scene = load_scene()
    np.save(place / "depth.npy", halved(scene.image.depth).numpy())
    np.save(place / "pose.npy", scene.image.obj_from_camera.numpy())
    (place / "out_of_it").symlink_to(DATA)
    return place


@pytest.fixture(scope="module")
def said(folder):
    """What a client hears by stdio: the calls by name, then the tools."""
    scene = load_scene()
    row, column = np.argwhere(halved(scene.pixel_labels).numpy() == THING).mean(0).tolist()
    k = scene.image.intrinsics / 2  # of the half image
    camera = [float(x) for x in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])]
    grasps = {"grasps": "out/tin/grasps.safetensors"}
    depth = {"depth": "depth.npy", "intrinsics": camera, "camera_pose": "pose.npy"}
    lift = {"mesh": "cylinder", "mass": 0.1, "hold_time": 0.2, "simulator": "mujoco"}
    calls = {
        "health": ("health", {}),
        "plan": ("plan_grasps_from_point_cloud", {"cloud": "tin.ply", "hand": "barrett", **FEW}),
        "show": ("show", grasps),
        "close": ("close_in_simulation", {**grasps, **lift}),
        "depth": (
            "plan_grasps_from_depth",
            {**depth, "point": [column, row], "hand": "barrett", "out": "seen", **FEW},
        ),
        "mesh": (
            "plan_grasps_from_mesh",
            {"mesh": "jug", "hand": "barrett", "out": "jug", "starts": 4},
        ),
        "explain": (
            "explain_empty",
            {"cloud": "cylinder", "hand": "barrett", "friction": 0.0, "starts": 4},
        ),
        "hand": ("check_hand", {"hand": "barrett"}),
        "label": ("explain_empty", {"cloud": "seen/scene.npz", "label": 77}),
        "cloud label": ("explain_empty", {"cloud": "tin.ply", "label": 1}),
        "cloud": ("check_cloud", {"cloud": "tin.ply"}),
        "rank": ("show", {**grasps, "rank": 9000}),
        "outside": ("check_cloud", {"cloud": "../tin.ply"}),
        "link": ("check_cloud", {"cloud": "out_of_it/jug/view.ply"}),
        "two": ("check_cloud", {"cloud": "two.npy"}),
        "mm": ("plan_grasps_from_point_cloud", {"cloud": "mm.npy"}),
        "starts": ("plan_grasps_from_point_cloud", {"cloud": "tin.ply", "starts": 10**6}),
        "both": (
            "plan_grasps_from_point_cloud",
            {"cloud": "tin.ply", "table": [0.0], "no_table": True},
        ),
        "octopus": ("check_hand", {"hand": "octopus"}),
        "unknown": ("juggle", {}),
    }
    found = converse([*COMMAND, str(folder)], calls.values())
    return dict(zip(calls, found["results"], strict=True)) | {"tools": found["tools"]}


@pytest.mark.sim
def test_tools_are_listed_with_units_and_bounds_and_answer_as_their_schemas_say(said):
    assert set(said["tools"]) == set(TOOLS)
    for name, tool in said["tools"].items():
        assert len(tool["said"]) > 20 and tool["given"]["additionalProperties"] is False
        for schema in (tool["given"], tool["answered"]):
            jsonschema.Draft202012Validator.check_schema(schema)
            for field, one in schema["properties"].items():
                assert one["description"] and "--" not in one["description"], (name, field)
    plan = said["tools"]["plan_grasps_from_point_cloud"]["given"]["properties"]
    assert plan["starts"]["maximum"] == 2000 and plan["starts"]["type"] == "integer"
    for field in ("viewpoint", "table", "mass", "keep"):
        assert any(unit in plan[field]["description"] for unit in UNITS), field
    tools = {
        "plan": "plan_grasps_from_point_cloud",
        "depth": "plan_grasps_from_depth",
        "mesh": "plan_grasps_from_mesh",
        "explain": "explain_empty",
        "close": "close_in_simulation",
        "hand": "check_hand",
        "cloud": "check_cloud",
        "show": "show",
        "health": "health",
    }
    for call, name in tools.items():
        assert not said[call]["error"], said[call]
        jsonschema.validate(said[call]["data"], said["tools"][name]["answered"])
        assert json.loads(said[call]["text"]) == said[call]["data"]


@pytest.mark.sim
def test_a_plan_answers_what_its_file_holds(said, folder):
    plan = said["plan"]["data"]
    grasps = load_grasps(folder / plan["grasps_file"])
    good = grasps[grasps.status == 0]
    assert plan["executable"] == len(good) > 2 and len(plan["grasps"]) == 2
    assert (folder / plan["surface_file"]).is_file() and plan["seen_file"] == "tin.ply"
    listed = json.loads((folder / plan["json_file"]).read_text())
    assert len(listed["grasps"]) == 2 and "units" in listed
    for k, row in enumerate(plan["grasps"]):
        pose = good.obj_from_hand[k].double().numpy()
        w, x, y, z = row["quaternion_wxyz"]
        turn = Rotation.from_quat([x, y, z, w]).as_matrix()
        np.testing.assert_allclose(turn, pose[:3, :3], atol=1e-5)
        np.testing.assert_allclose(row["position"], pose[:3, 3], atol=1e-6)
        names = [*row["grasp"]]
        assert {"spread", "f1_flex", "f2_flex", "f3_flex"} <= {*names}
        moved = [row["grasp"][n] for n in ("spread", "f1_flex", "f2_flex", "f3_flex")]
        np.testing.assert_allclose(moved, good.joints[k].double().numpy(), atol=1e-6)
        low, high = row["interval"]
        assert 0 <= low < high <= 1 and 0 < row["success"] < 1


@pytest.mark.sim
def test_the_grasp_is_shown_and_holds_in_simulation(said):
    picture = Image.open(io.BytesIO(base64.b64decode(said["show"]["pictures"][0])))
    picture.load()
    assert picture.format == "PNG" and min(picture.size) > 300
    # the object, the hand, and three fingers in their colours
    assert len(picture.convert("RGB").quantize(16).getcolors()) == 16
    assert "barrett" in said["show"]["data"]["caption"]
    close = said["close"]["data"]
    assert close["held"] and close["status"] == "OK" and close["rise"] > 0.05
    assert {*close["touched"]} == {"f1", "f2", "f3"} and close["slip"] < 0.02


@pytest.mark.sim
def test_a_depth_image_and_a_mesh_are_planned_on_and_an_empty_plan_is_explained(said, folder):
    for call in ("depth", "mesh"):
        plan = said[call]["data"]
        assert plan["executable"] > 0 and (folder / plan["seen_file"]).is_file(), plan["verdict"]
    scene = load_scene()
    middle = scene.points[scene.rows_of(THING)].double().mean(0).numpy()
    for row in said["depth"]["data"]["grasps"]:  # the hand is at the object of the pixel
        assert np.linalg.norm(row["position"] - middle) < 0.35
    told = said["explain"]["data"]
    assert "friction" in told["advice"] and told["changes"][0]["executable"] > 0
    assert told["stages"][0]["kept"] == 0
    assert said["hand"]["data"]["sound"] and said["hand"]["data"]["sets"]["default"]
    assert {x["name"] for x in said["hand"]["data"]["abilities"]["fingers"]} == {"f1", "f2", "f3"}
    assert said["cloud"]["data"]["usable"] and said["cloud"]["data"]["camera_given"]


@pytest.mark.sim
@pytest.mark.parametrize(
    ("call", "words"),
    [
        ("outside", r"^cloud: expected a path below .*, without \.\. .*, got '\.\./tin\.ply'$"),
        ("link", r"^cloud: expected a path below .* without a link out of it, got 'out_of_it"),
        ("two", r"^cloud: expected at least 4 points, got .*two.npy with 2 points$"),
        ("mm", r"^cloud: expected .*unit"),
        ("starts", r"^starts: expected a whole number in \[1, 2000\], got 1000000$"),
        ("both", r"^table: expected one of the two, got 0 and no_table$"),
        ("rank", r"^rank: expected a rank below \d+, .*, got 9000$"),
        ("label", r"^target: expected .*77"),
        ("cloud label", r"^label: expected a scene, which has labels, got a label beside a cloud$"),
        ("octopus", r"^hand: expected one of \['allegro', .*'.*octopus'$"),
        ("unknown", r"^tool: expected one of plan_grasps_from_point_cloud, .*, got 'juggle'$"),
    ],
)
def test_a_wrong_call_is_answered_by_one_sentence(said, call, words):
    if call == "octopus":
        assert not said[call]["error"] and not said[call]["data"]["sound"]
        assert re.search(words, said[call]["data"]["faults"][0])
        return
    assert said[call]["error"] and re.search(words, said[call]["text"]), said[call]
    assert "\n" not in said[call]["text"] and "Traceback" not in said[call]["text"]


@pytest.fixture
def address(folder):
    """The address of a server by HTTP whose calls end after a second."""
    if not PYTHON.exists():
        pytest.skip("scripts/beside mcp makes the environment of the SDK")
    words = [*COMMAND, str(folder), "--http", "0", "--seconds", "1"]
    with subprocess.Popen(
        words, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True
    ) as server:
        assert server.stderr is not None
        yield server.stderr.readline().split()[-1]
        server.send_signal(signal.SIGTERM)
        assert server.stderr.read().endswith("torchgrasp: terminated\n")
    assert server.returncode == 143


def test_http_is_served_to_this_machine_alone_and_long_calls_are_ended(address):
    long = ("plan_grasps_from_point_cloud", {"cloud": "jug", "starts": 2000})
    found = converse(address, [long, (*long, 0.5), ("health", {}), ("check_hand", {"hand": "x"})])
    ended, cancelled, health, again = found["results"]
    assert ended["error"] and re.search(
        "^call: .*, got one that was ended after 1 s", ended["text"]
    )
    assert cancelled is None and health["data"]["seconds"] == 1.0
    assert not again["data"]["sound"]  # another process works on it
    host, port = re.findall(r"//(.*):(\d+)/mcp$", address)[0]
    assert host == "127.0.0.1"
    codes = []
    for header in ({"Host": "grasps.example"}, {"Origin": "http://grasps.example"}, {}):
        kinds = {
            "Content-Type": "application/json",
            "Accept": "application/json, text/event-stream",
        }
        call = {"jsonrpc": "2.0", "id": 1, "method": "tools/list", "params": {}}
        with contextlib.closing(http.client.HTTPConnection(host, int(port), timeout=20)) as wire:
            wire.request("POST", "/mcp", json.dumps(call), {**kinds, **header})
            with wire.getresponse() as reply:
                codes.append(reply.status)
    assert codes[:2] == [421, 403] and codes[2] not in (421, 403)


def test_a_signal_ends_a_server_that_waits_for_its_client(folder):
    """The client keeps its end of stdin open, as an agent does that is stopped."""
    if not PYTHON.exists():
        pytest.skip("scripts/beside mcp makes the environment of the SDK")
    hello = {"protocolVersion": "2025-06-18", "capabilities": {}}
    hello |= {"clientInfo": {"name": "a client", "version": "1"}}
    call = {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": hello}
    with subprocess.Popen(
        [*COMMAND, str(folder)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as server:
        assert server.stdin and server.stdout and server.stderr
        server.stdin.write(json.dumps(call) + "\n")
        server.stdin.flush()
        assert json.loads(server.stdout.readline())["result"]["serverInfo"]["name"] == "torchgrasp"
        server.send_signal(signal.SIGTERM)
        assert server.wait(60) == 143 and server.stderr.read() == "torchgrasp: terminated\n"


def test_the_client_of_the_guide_plans(tmp_path):
    """The Python of docs/agents.md, with few starts, and `torchgrasp` in the path."""
    if not PYTHON.exists():
        pytest.skip("scripts/beside mcp makes the environment of the SDK")
    guide = (ROOT / "docs" / "agents.md").read_text()
    code = re.findall(r"^```python\n(.*?)^```", guide, re.MULTILINE | re.DOTALL)[0]
    code = code.replace('{"cloud": "jug"}', '{"cloud": "cylinder", "hand": "barrett", "starts": 8}')
    assert "starts" in code
    command = tmp_path / "bin" / "torchgrasp"
    command.parent.mkdir()
    words = f'PYTHONPATH={ROOT} exec {PYTHON} -m torchgrasp "$@"'
    command.write_text(f"#!/bin/sh\n{words}\n")
    command.chmod(0o755)
    (tmp_path / "grasps").mkdir()
    path = f"{command.parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [PYTHON, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
    )
    assert re.search(r"The barrett hand has \d+ executable grasps", done.stdout), done.stderr


def test_paths_stay_below_the_folder(folder, tmp_path):
    place = Workplace.at(folder)
    assert place.file("cloud", "tin.ply") == folder.resolve() / "tin.ply"
    assert place.file("cloud", str(folder.resolve() / "tin.ply")).name == "tin.ply"
    assert place.mesh("mesh", "jug") == DATA / "jug" / "mesh.ply"
    assert place.tell(place.out(None, Path("tin.ply"))) == "out/tin"
    (folder / "loop").symlink_to(folder / "loop")
    for text in ("..", "a/../tin.ply", "/etc/hostname", "out_of_it/jug", "loop", "a\0b", "x" * 999):
        with pytest.raises(BadArgument, match=r"^cloud: "):
            place.place("cloud", text)
    with pytest.raises(BadArgument, match="expected a file below"):
        place.file("cloud", "none.ply")
    hand = folder / "mine"
    hand.mkdir()
    (hand / "meshes").symlink_to(tmp_path)
    with pytest.raises(BadArgument, match="without a link out of it"):
        place.hand("hand", "mine")
    shutil.rmtree(hand)
    with pytest.raises(BadArgument, match=r"^--folder: expected a folder that exists"):
        Workplace.at(tmp_path / "none")


def test_a_file_of_grasps_names_no_folder_of_a_hand(folder, tmp_path):
    """The hand of a file is read only if it is shipped, or below the folder and given."""
    shutil.copytree(hands_folder() / "barrett", tmp_path / "hand")
    grasp = load_shipped_grasp("jug", "barrett")
    for name in (str(tmp_path / "hand"), "mine"):
        dataclasses.replace(grasp, meta=grasp.meta | {"hand": name}).save(folder / "x.safetensors")
        tool = make_tool("show", {"grasps": "x.safetensors", "mesh": "jug"})
        with pytest.raises(BadArgument, match=r"^hand: expected the folder of the .* hand below"):
            tool.run(Workplace.at(folder))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "^cloud: expected point cloud .*, got nothing$"),
        ({"cloud": 3}, "^cloud: expected a text, got 3$"),
        ({"cloud": "jug", "seed": -1}, "^seed: "),
        ({"cloud": "jug", "friction": float("nan")}, "^friction: expected a number in"),
        ({"cloud": "jug", "mass": [1]}, "^mass: expected "),
        ({"cloud": "jug", "up": [0, 1]}, "^up: "),
        ({"cloud": "jug", "unit": "inch"}, "^unit: expected one of 'm', 'cm', 'mm', got 'inch'$"),
        ({"cloud": "jug", "strats": 3}, "^strats: expected one of cloud, .* that .* lacks$"),
        ({"cloud": "jug", "most": True}, "^most: expected a whole number in .*, got True$"),
    ],
)
def test_arguments_are_checked_before_any_work(given, words):
    with pytest.raises(BadArgument, match=words):
        make_tool("plan_grasps_from_point_cloud", given)


def test_an_uncertain_friction_and_mass_are_texts():
    given = {"cloud": "jug", "friction": "0.2:0.8", "mass": "0.1|0.4"}
    tool = make_tool("plan_grasps_from_point_cloud", given)
    assert tool.law == Distribution.between(0.2, 0.8)
    assert tool.grasp_task == GraspTask(Distribution.parse("0.1|0.4"))
    assert make_tool("plan_grasps_from_point_cloud", {"cloud": "jug"}).law == 0.8
    with pytest.raises(BadArgument, match=r"^friction: expected a number, an interval"):
        make_tool("plan_grasps_from_point_cloud", {"cloud": "jug", "friction": "slippery"}).law


def test_a_plan_says_from_where_to_look_next_unless_a_grasp_is_likely_enough(tmp_path, monkeypatch):
    given = {"cloud": "cylinder", "hand": "barrett", "starts": 8}
    tool = make_tool("plan_grasps_from_point_cloud", given)
    found = {}
    for enough in (0.0, 1.0):
        monkeypatch.setattr("torchgrasp.app.cli.results.ENOUGH", enough)
        found[enough] = tool.run(Workplace.at(tmp_path)).look_next
    look = found[1.0]
    assert found[0.0] is None
    assert look.turn_deg > 45 and look.std_after_m < look.std_before_m
    eye = torch.tensor(look.obj_from_camera_m)[:3, 3]
    seen = load_object("cylinder").view.viewpoint
    assert float(torch.linalg.vector_norm(eye - seen)) > 0.1


class Noisy(Tool):
    """A tool whose libraries print and warn; with an error, it fails as none of the library's does."""

    def __init__(self, error=None):
        self.error = error

    def run(self, place):
        os.write(1, b"a library prints\n")
        warnings.warn("the cloud has --unit mm", UserWarning, stacklevel=1)
        if self.error:
            raise self.error
        return Answer(notes=("give --viewpoint X Y Z",))


def test_what_libraries_print_misses_the_protocol_and_warnings_are_told(folder, capfd):
    place = Workplace.at(folder)
    answer = agent_server.do_work(Noisy(), place)
    assert plain_answer(answer) == {"notes": ["give viewpoint X Y Z", "the cloud has unit mm"]}
    with pytest.raises(
        GraspError, match=r"ended the work \(ZeroDivisionError\); the standard error"
    ):
        agent_server.do_work(Noisy(ZeroDivisionError("secret")), place)
    out, err = capfd.readouterr()
    assert out == "" and err.count("a library prints") == 2


def test_the_command_names_what_is_missing(run_command, folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcp", None)
    code, out, err = run_command("mcp", "--folder", folder)
    told = "torchgrasp: mcp is not installed: pip install 'torchgrasp[mcp]'\n"
    assert (code, out, err) == (2, "", told)
    for port in (-1, 99_999):
        with pytest.raises(
            BadArgument, match=r"^--http: expected a port up to 65535, or 0 for any"
        ):
            agent_server.bind_port(port)
    with agent_server.bind_port(0) as bound:
        host, port = bound.getsockname()
        assert host == "127.0.0.1"
        with pytest.raises(BadArgument, match=r"^--http: expected a free port.*in use"):
            agent_server.bind_port(port)


def test_numbers_of_answers_are_finite_and_short():
    row = ChangeRow(change="x", choice=True, executable=1, expected=float("nan"))
    answer = ExplainAnswer(advice="y", starts=1, stages=(), changes=(row,), notes=())
    plain = plain_answer(answer)
    assert plain["changes"] == [{"change": "x", "choice": True, "executable": 1, "expected": None}]
    close = dataclasses.replace(row, expected=1 / 3)
    plain = plain_answer(dataclasses.replace(answer, changes=(close,)))
    assert plain["changes"][0]["expected"] == 0.333333
