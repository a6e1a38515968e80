"""`torchgrasp grasp` on scenes: what is taken, and one sentence for each bad input."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.ndimage import binary_dilation

from tests.make import HALF, box, halved
from torchgrasp import Scene, Status, load_grasps, read_scene, save_scene
from torchgrasp.cloud.camera import look_at, render_depth
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.support_search import find_supports
from torchgrasp.planner import ScenePlan, ThingPlan

CAMERA = look_at(20.0, 45.0, 0.7)


def boxes(lift: float = 0.0) -> list[trimesh.Trimesh]:
    meshes = [trimesh.creation.box([0.06, 0.06, 0.12]), trimesh.creation.box([0.06, 0.06, 0.08])]
    for mesh, (x, y, z) in zip(meshes, ((0.0, 0.0, 0.06), (0.02, 0.15, 0.04)), strict=True):
        mesh.apply_translation([x, y, z + lift])
    return meshes


def arrays_of(depth: torch.Tensor, labels: torch.Tensor, intrinsics: torch.Tensor):
    """Return the arrays of a scene's file."""
    return {
        "depth": np.round(1e3 * depth.numpy()).astype(np.uint16),
        "intrinsics": intrinsics.numpy(),
        "camera_pose": CAMERA.numpy(),
        "labels": labels.numpy(),
    }


@pytest.fixture(scope="module")
def seen():
    """Arrays of a picture of half the size."""
    return arrays_of(*map(halved, render_depth(boxes(), CAMERA)), HALF)


@pytest.fixture
def grasp(tmp_path, run_command):
    """Return a function that writes a scene, runs the command and returns its exit code and words."""

    def run(arrays: dict[str, np.ndarray], *options: str) -> tuple[int, str]:
        np.savez(tmp_path / "scene.npz", **arrays)
        words = [
            "grasp",
            tmp_path / "scene.npz",
            "--hand",
            "barrett",
            "--out",
            tmp_path / "out",
            *options,
        ]
        code, out, err = run_command(*words)
        return code, err if code == 2 else out

    return run


def middle(labels: np.ndarray, label: int) -> tuple[str, str]:
    """Return column and row of a pixel inside a label."""
    row, column = np.nonzero(labels == label)
    return str(int(np.median(column))), str(int(np.median(row)))


@pytest.fixture(autouse=True)
def no_report(monkeypatch):
    monkeypatch.setattr("torchgrasp.app.report.page.write_report", lambda path, run, view: path)
    monkeypatch.setattr("torchgrasp.app.report.viewer.write_viewer", lambda path, run: path)


@pytest.mark.parametrize("click", [True, False])
def test_a_thing_is_grasped_by_click_or_mask(seen, grasp, tmp_path, click):
    arrays = dict(seen)
    options = ["--point", *middle(seen["labels"], 1)]
    if not click:  # and by metres with gaps
        depth = seen["depth"] / 1e3
        depth[::7, ::5] = np.nan
        depth[3::11, ::3] = 0.0
        arrays |= {"depth": depth, "mask": (arrays.pop("labels") == 1).astype(np.uint8)}
        options = []
    code, words = grasp(arrays, "--starts", "10", *options)
    assert code == 0 and "executable grasps" in words
    best = load_grasps(tmp_path / "out" / "grasps.safetensors")[0]
    assert int(best.status) == Status.OK
    assert (
        float(best.contacts.points[0, :, :2].abs().max()) < 0.05
    )  # of the first box, not of the second


def test_without_a_choice_the_easiest_thing_is_taken_and_all_are_listed(seen, grasp, monkeypatch):
    thing = ThingPlan(2, 0.5, reason="too heavy")
    asked = []

    def note(scene, hand, *_, fingers, enough, task, promise, resist, **where):
        asked.append((hand.finger_names, fingers))
        assert task.mass == 0.4 and promise == 0.8 and resist == ("lift",)
        return ScenePlan((thing,))

    monkeypatch.setattr("torchgrasp.app.cli.grasp.plan_scene", note)
    for wanted, passed in (("default", None), ("f3,f1,f2", None), ("auto", "auto")):
        code, words = grasp(
            seen, "--fingers", wanted, "--mass", "0.4", "--promise", "0.8", "--resist", "lift"
        )
        assert asked.pop() == (("f3", "f1", "f2") if "," in wanted else ("f1", "f2", "f3"), passed)
    assert (
        code == 1
        and "object 2" in words
        and "too heavy" in words
        and "no executable grasp of any object" in words
    )


TOUCHING = [((0.06, 0.08, 0.12), (-0.031, 0.0)), ((0.06, 0.1, 0.05), (0.03, 0.02))]
APART = [((0.05, 0.05, 0.09), (0.0, -0.06)), ((0.05, 0.05, 0.09), (0.0, 0.06))]


@pytest.mark.parametrize(
    ("bodies", "choice"), [(TOUCHING, ("--label", "1")), (TOUCHING, ()), (APART, ())]
)
def test_why_the_success_of_an_outline_is_unknown_is_told_in_words_and_as_json(
    tmp_path, run_command, bodies, choice
):
    depth, labels = map(halved, render_depth([box(*one) for one in bodies], CAMERA))
    arrays = arrays_of(depth, labels, HALF)
    del arrays["labels"]
    path = tmp_path / "scene.npz"
    np.savez(path, **arrays)
    options = ("--hand", "barrett", "--starts", "10", "--out", tmp_path / "out", *choice)
    code, out, err = run_command("grasp", path, *options, "--json")
    told = json.loads(out)
    assert code == 0 and told["executable"] > 0
    doubts = read_scene(path).select(told["label"]).doubts
    assert told["doubts"] == list(doubts) and bool(doubts) == (bodies is TOUCHING)
    assert (told["best"]["success"] is None) == bool(doubts)
    for sentence in doubts:
        assert err.count(f"advice  {sentence}") == 1
    assert err.count("its success is unknown") == bool(doubts)


def write(path: Path, seen: dict[str, np.ndarray], table: float, **choice: object) -> Scene:
    """Write a scene on a wrong table, with a target or labels; return the scene."""
    images = (seen[name] for name in ("depth", "intrinsics", "camera_pose"))
    scene = Scene.from_depth(*images, table=table, **choice)
    save_scene(scene, path)
    return scene


@pytest.fixture
def planned(monkeypatch):
    """Return the list of scenes that `torchgrasp grasp` plans; nothing is planned."""
    scenes = []

    def note(scene, *_, **__):
        scenes.append(scene)
        raise BadArgument("stop", "a scene", "none")

    for name in ("plan_grasps", "plan_scene"):
        monkeypatch.setattr(f"torchgrasp.app.cli.grasp.{name}", note)
    return scenes


def image_of(scene: Scene) -> np.ndarray:
    """Return the label of each pixel of a scene."""
    labels = np.zeros(scene.image.depth.shape, dtype=int)
    labels[tuple(scene.pixels.numpy().T)] = scene.labels.numpy()
    return labels


@pytest.fixture
def grasp_on(tmp_path, run_command):
    """Return a function that runs the command on a scene with more options, and returns its words."""

    def run(*options: str) -> str:
        code, out, err = run_command(
            "grasp", tmp_path / "s.npz", "--hand", "barrett", "--out", tmp_path / "o", *options
        )
        assert code == 2
        return out + err

    return run


@pytest.mark.parametrize("options", [("--table", "0.001"), ("--up", "0", "0.1", "1")])
def test_objects_that_the_library_found_are_found_again_on_another_table(
    seen, tmp_path, planned, grasp_on, options
):
    scene = write(tmp_path / "s.npz", seen, 0.03, point=[int(x) for x in middle(seen["labels"], 2)])
    assert "objects found again: 1, 2\n" in grasp_on(*options)
    (again,) = planned
    assert again.given == () and again.target == scene.target
    assert set(again.things) == {1, 2} and abs(again.table.offset) < 0.005
    before = image_of(scene) == scene.target
    after = image_of(again) == scene.target
    assert (
        before & after
    ).sum() > 0.95 * before.sum() and after.sum() > 1.2 * before.sum()  # down to the table


@pytest.mark.parametrize(
    ("options", "given", "searches"),
    [
        ((), {}, 1),
        (("--up", "0", "0.1", "1"), {"up": (0.0, 0.1, 1.0)}, 1),
        (("--table", "0.001"), {"table": 0.001}, 0),
    ],
)
def test_planes_are_searched_once_at_most(
    seen, tmp_path, planned, grasp_on, monkeypatch, options, given, searches
):
    calls = []

    def count(*arguments, **options):
        calls.append(arguments)
        return find_supports(*arguments, **options)

    monkeypatch.setattr("torchgrasp.geometry.support_search.find_supports", count)
    bare = {name: seen[name] for name in ("depth", "intrinsics", "camera_pose")}
    np.savez(tmp_path / "s.npz", **bare)
    grasp_on(*options)
    assert len(calls) == searches and len(planned) == 1
    assert planned[0] == Scene.from_depth(*bare.values(), **given)


def test_a_given_table_helps_where_none_is_found(seen, tmp_path, planned, grasp_on):
    bare = {name: seen[name] for name in ("depth", "intrinsics", "camera_pose")}
    bare["depth"] = bare["depth"] * (seen["labels"] == 1)
    np.savez(tmp_path / "s.npz", **bare)
    assert "plane" in grasp_on() and not planned
    grasp_on("--table", "0")
    assert planned[0].things == (1,) and planned[0].table.offset == 0.0
    assert "--table: expected" in grasp_on("--table", "5")


def test_beside_a_mask_of_the_user_other_objects_are_found_again(seen, tmp_path, planned, grasp_on):
    scene = write(tmp_path / "s.npz", seen, 0.03, mask=seen["labels"] == 2)
    words = grasp_on("--table", "0.0")
    assert (
        "objects kept, but for pixels of the table: 1\n" in words
        and "objects found again: 2\n" in words
    )
    before = image_of(scene)
    # a mask that lost its flying pixels loses none when it is read again
    assert ((image_of(read_scene(tmp_path / "s.npz")) == 1) == (before == 1)).all()
    after = image_of(planned[0])
    for label in (1, 2):  # down to the table
        assert (
            not ((before == label) & (after != label)).any()
            and (after == label).sum() > 1.2 * (before == label).sum()
        )


@pytest.mark.parametrize("form", ["mask", "labels"])
def test_what_the_user_gave_only_loses_the_pixels_of_another_table(
    seen, tmp_path, planned, grasp_on, form
):
    column = int(np.nonzero(seen["labels"] == 2)[1].mean())
    box = seen["labels"] == 2
    own = binary_dilation(seen["labels"] == 2, iterations=6)
    # half of a box: no segmentation finds it
    box[:, :column] = False
    own[:, :column] = False
    scene = write(tmp_path / "s.npz", seen, -0.03, **{form: own if form == "mask" else 7 * own})
    label = 1 if form == "mask" else 7
    assert (
        scene.given == (label,) and (image_of(scene) == label).sum() > 1.2 * box.sum()
    )  # with a strip of the table
    assert f"objects kept, but for pixels of the table: {label}\n" in grasp_on("--table", "0.0")
    (again,) = planned
    assert again.given == (label,) and again.target == (1 if form == "mask" else None)
    assert again.things == (label,)
    before = image_of(scene) == label
    kept = image_of(again) == label
    high = before & box & (again.table.height(again.image.points()).numpy() > 0.01)
    assert (kept & high).sum() > 0.99 * high.sum() and kept[
        ~binary_dilation(box, iterations=2)
    ].sum() < 5


def test_a_target_that_is_lost_on_another_table_is_told(seen, tmp_path, planned, grasp_on):
    around = binary_dilation(seen["labels"] > 0, iterations=20).astype(
        int
    )  # an older file with boxes and table as one
    np.savez(
        tmp_path / "s.npz", **seen | {"labels": around, "table": [0, 0, 1, -0.03], "target": 1}
    )
    error = grasp_on("--table", "0.0")
    assert (
        error.startswith("torchgrasp: --table: ")
        and "object 1, the target, is lost" in error
        and not planned
    )
    grasp_on("--table", "0.0", "--point", *middle(seen["labels"], 1))
    assert [scene.target in (2, 3) for scene in planned] == [True]
    beside = 2 * (around - binary_dilation(seen["labels"] > 0, iterations=5))  # a part of the table
    write(tmp_path / "s.npz", seen, -0.03, labels=beside)
    assert "every object is lost" in grasp_on("--table", "0.0")
    write(tmp_path / "s.npz", seen, -0.03, labels=np.where(seen["labels"] == 1, 1, beside))
    assert "objects lost: 2\n" in grasp_on("--table", "0.0")


def test_what_the_picture_says_against_a_chosen_object_is_told_before_planning(
    seen, tmp_path, planned, grasp_on
):
    labels = np.where(
        np.cumsum(seen["labels"] == 2).reshape(seen["labels"].shape) <= 60, seen["labels"], 0
    )
    np.savez(tmp_path / "s.npz", **seen | {"labels": labels})
    assert (
        f"advice  {Status.FEW_PIXELS.sentence}" in grasp_on("--label", "2")
        and planned[0].target == 2
    )
    assert "advice" not in grasp_on("--label", "1")
    # what was changed in reading the scene, too
    wide = np.where(binary_dilation(seen["labels"] == 1, iterations=15), 1, 0)
    np.savez(tmp_path / "s.npz", **seen | {"labels": wide, "depth_scale": 0.001})
    words = grasp_on("--label", "1")
    for note in read_scene(tmp_path / "s.npz").notes:
        assert f"note    {note}" in words
    assert "note    arrays depth_scale were not read" in words


BAD = {
    "no plane": (lambda a: {**a, "depth": a["depth"] * (a["labels"] == 1)}, [], "plane"),
    "empty mask": (lambda a: {**a, "labels": None, "mask": 0 * a["labels"]}, [], "mask"),
    "mask of another size": (
        lambda a: {**a, "labels": None, "mask": a["labels"][::2, ::2] > 0},
        [],
        "mask",
    ),
    "labels of another size": (lambda a: {**a, "labels": a["labels"][::2, ::2]}, [], "labels"),
    "intrinsics of another resolution": (
        lambda a: {**a, "intrinsics": 2 * a["intrinsics"]},
        [],
        "intrinsics",
    ),
    "depth in mm, floating": (lambda a: {**a, "depth": a["depth"].astype(np.float32)}, [], "mm"),
    "no depth": (lambda a: {**a, "depth": 0 * a["depth"]}, [], "depth"),
    "a pose that is not rigid": (
        lambda a: {**a, "camera_pose": 2 * a["camera_pose"]},
        [],
        "camera_pose",
    ),
    "a table above the camera": (
        lambda a: {**a, "table": np.array([0.0, 0.0, 1.0, 5.0])},
        [],
        "table",
    ),
    "a target that is the table": (lambda a: a, ["--point", "160", "220"], "--point"),
    "a pixel outside the image": (lambda a: a, ["--point", "900", "20"], "--point"),
    "an unknown label": (lambda a: a, ["--label", "9"], "--label"),
    "an option of clouds": (lambda a: a, ["--no-table"], "scene"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_scene_is_refused_in_one_sentence(seen, grasp, case):
    change, options, word = BAD[case]
    arrays = {name: array for name, array in change(dict(seen)).items() if array is not None}
    code, words = grasp(arrays, *options)
    assert code == 2, words
    assert word in words and len(words.strip().splitlines()) == 1


def test_a_label_needs_a_scene(tmp_path, refusal):
    np.save(tmp_path / "cloud.npy", np.random.default_rng(0).random((50, 3)))
    assert "--label" in refusal("grasp", tmp_path / "cloud.npy", "--out", tmp_path, "--label", "1")


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04", b"not a zip"])
def test_a_broken_scene_file_is_refused(tmp_path, refusal, data):
    (tmp_path / "scene.npz").write_bytes(data)
    refusal("grasp", tmp_path / "scene.npz", "--out", tmp_path / "out")


def test_cloud_scene_tells_a_pose_of_opengl_and_a_wrong_unit(seen, tmp_path, refusal):
    np.save(tmp_path / "d.npy", seen["depth"])
    np.savetxt(tmp_path / "gl.txt", seen["camera_pose"] @ np.diag([1.0, -1.0, -1.0, 1.0]))
    k = [str(float(HALF[i, j])) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    words = ["cloud", "scene", tmp_path / "d.npy", "--intrinsics", *k, "--out", tmp_path / "s.npz"]
    error = refusal(*words, "--camera-pose", tmp_path / "gl.txt")
    assert (
        error.startswith("--camera-pose: ")
        and "OpenGL" in error
        and not (tmp_path / "s.npz").exists()
    )
    assert "--depth-unit" in refusal(*words, "--depth-unit", "0.01")


def run_lengths(mask):
    edges = np.flatnonzero(np.diff(mask.T.ravel(), prepend=False, append=False))
    return {
        "size": list(mask.shape),
        "counts": np.diff(edges, prepend=0, append=mask.size).tolist(),
    }


def save_as(path, labels, form):
    """Write labels as another tool does."""
    several = [labels == k for k in range(1, int(labels.max()) + 1)]
    colours = np.array([[0, 0, 0], [0, 9, 7], [200, 0, 0]], dtype=np.uint8)[labels]
    if form == "rle.json":
        path.write_text(json.dumps([{"segmentation": run_lengths(mask)} for mask in several]))
    elif form == "one.json":
        path.write_text(json.dumps(run_lengths(labels > 0)))
    elif form == "list.npz":
        np.savez(path, *several)
    elif form == "stack.npy":
        np.save(path, np.stack(several))
    elif form == "alpha.png":
        Image.fromarray(
            np.concatenate([colours, np.full((*labels.shape, 1), 255, dtype=np.uint8)], -1)
        ).save(path)
    else:
        Image.fromarray(
            colours if form == "colours.png" else labels.astype(form.split(".")[0])
        ).save(path)
    return path


FORMS = ["rle.json", "list.npz", "alpha.png", "int32.tiff"]
"""One of each kind of file; every form of labels is read in tests/scene/test_masks.py."""


@pytest.fixture
def scene_words(seen, tmp_path):
    np.save(tmp_path / "d.npy", seen["depth"])
    np.savetxt(tmp_path / "pose.txt", seen["camera_pose"])
    k = [str(float(HALF[i, j])) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))]
    words = [tmp_path / "d.npy", "--intrinsics", *k, "--out", tmp_path / "s.npz"]
    return [*words, "--camera-pose", tmp_path / "pose.txt"]


@pytest.mark.parametrize("form", FORMS)
def test_masks_of_each_form_are_the_objects_and_a_point_chooses(
    seen, scene_words, tmp_path, run_command, form
):
    path = save_as(tmp_path / form, seen["labels"], form)
    point = ["--point", *middle(seen["labels"], 2)]
    code, said, _ = run_command("cloud", "scene", *scene_words, "--mask", path, *point)
    found = read_scene(tmp_path / "s.npz")
    assert (
        code == 0
        and found.things == (1, 2)
        and found.target == 2
        and "object 2" in said
        and "note" not in said
    )
    own = found.pixels[found.rows_of(2)]
    assert (seen["labels"][tuple(own.T.numpy())] == 2).mean() > 0.99


@pytest.mark.parametrize("form", ["one.json", "colours.png"])
def test_a_mask_of_one_object_is_the_target_and_the_table_below_is_told(
    seen, scene_words, tmp_path, run_command, form
):
    mask = seen["labels"] == 1
    row, column = np.nonzero(mask)
    mask[row.min() : row.max() + 10, column.min() : column.max() + 1] = (
        True  # with a strip of the table
    )
    path = save_as(tmp_path / form, mask.astype(int), form)
    code, said, _ = run_command("cloud", "scene", *scene_words, "--mask", path)
    assert (
        code == 0
        and "(the target)" in said
        and "pixels lie on the support and were removed" in said
    )
    found = read_scene(tmp_path / "s.npz")
    assert found.target == 1 and float(torch.quantile(found.cloud().points[:, 2], 0.02)) > 0.002
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code, *texts = run_command("cloud", "depth", *scene_words, "--mask", path)
    assert code == 0 and "of its points lie on the table beside the object" in "".join(texts)


BAD_MASKS = {
    "m.json": (b"{", "well-formed .json"),
    "n.json": (b'{"size": [240, 320], "counts": [1, 2]}', "run lengths"),
    "o.json": (b'[{"segmentation": [[1, 2, 3, 4]]}]', "shape"),
    "p.json": (b"[" * 9999, "well-formed .json"),
    "q.png": (b"x" * 99, "well-formed .png"),
    "r.jpg": (b"x" * 99, ".json file"),
}


@pytest.mark.parametrize("name", BAD_MASKS)
def test_a_bad_file_of_masks_is_refused_in_one_sentence(scene_words, tmp_path, refusal, name):
    (tmp_path / name).write_bytes(BAD_MASKS[name][0])
    error = refusal("cloud", "scene", *scene_words, "--mask", tmp_path / name)
    assert (
        error.startswith("--mask: ")
        and BAD_MASKS[name][1] in error
        and not (tmp_path / "s.npz").exists()
    )


def test_a_cloud_needs_a_mask_of_one_object(seen, scene_words, tmp_path, refusal):
    path = save_as(tmp_path / "m.png", seen["labels"], "colours.png")
    assert "--mask: expected one object" in refusal("cloud", "depth", *scene_words, "--mask", path)
