"""The commands for clouds, and what `grasp` and `cloud check` say of clouds as users bring them."""

import functools
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from tests.make import HALF, box, halved
from torchgrasp import Scene, read_cloud, read_scene
from torchgrasp.app import cli
from torchgrasp.app.cli import grasp as grasps
from torchgrasp.app.cli.inputs import CloudOptions, ViewOptions, read_region
from torchgrasp.cloud import (
    diagnose_cloud,
    estimate_normals,
    look_at,
    partial_view,
    read_cloud_file,
    save_cloud,
)
from torchgrasp.cloud.camera import INTRINSICS, render_depth
from torchgrasp.cloud.check import remove_outliers
from torchgrasp.cloud.safe_files import read_image_file
from torchgrasp.data.shipped import DATA, load_object, load_scene
from torchgrasp.foundation.errors import BadArgument, NoEffect
from torchgrasp.geometry.plane import Plane, as_plane
from torchgrasp.scene.image import DepthImage
from torchgrasp.shape.fit import fit_shape
from torchgrasp.values.planning import PointCloud

VIEW = DATA / "jug" / "view.ply"
POSE = look_at(30.0, 40.0, 0.6, torch.tensor([0.0, 0.0, 0.07], dtype=torch.float64))
DOWN = [1, 0, 0], [0, -1, 0], [0, 0, -1]


@functools.cache
def jug():
    return partial_view(load_object("jug").mesh, POSE, 1000)


def turned(cloud, *rows):
    """Return a cloud in a frame whose axes are the rows."""
    assert cloud.viewpoint is not None
    axes = torch.tensor(rows, dtype=torch.float64)
    return PointCloud(cloud.points @ axes.T, None, cloud.viewpoint @ axes.T)


def stack(*meshes):
    """Return vertices and faces of several meshes."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = [m.faces + k for m, k in zip(meshes, starts[:-1], strict=True)]
    return np.concatenate([m.vertices for m in meshes]), np.concatenate(faces)


@functools.cache
def with_table(side=0.24):
    """Return a view of the jug and of a patch of the table around it."""
    mesh = load_object("jug").mesh
    box = trimesh.creation.box((side, side, 0.01))
    box.apply_translation((0, 0, -0.005))
    return partial_view(trimesh.Trimesh(*stack(mesh, box)), POSE, 4000)


def in_camera(cloud, pose=POSE):
    """Return a cloud in the frame of its camera."""
    return PointCloud(
        (cloud.points - pose[:3, 3]) @ pose[:3, :3], None, torch.zeros(3, dtype=torch.float64)
    )


def mirrored():
    """Return the jug with a camera on the other side, as far below it as the true one is above."""
    centre = (jug().points.amax(0) + jug().points.amin(0)) / 2
    return PointCloud(jug().points, None, 2 * centre - POSE[:3, 3])


def unknown(cloud):
    return PointCloud(cloud.points)


def pcd(cloud):
    """Write what drivers write: rows with NaN and the default viewpoint."""
    rows = np.concatenate([cloud.points.numpy(), np.full((7, 3), np.nan)])
    head = f"FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nDATA binary\n"
    return head.encode() + rows.tobytes()


def write(path, value):
    if isinstance(value, PointCloud):
        save_cloud(value, path)
    elif isinstance(value, bytes):
        path.write_bytes(value)
    else:
        np.save(path, value)
    return path


def moved(x):
    return jug().points + torch.tensor([x, 0.0, 0.0], dtype=torch.float64)


def seen_from(*eye):
    return PointCloud(moved(0.5), None, torch.tensor(eye, dtype=torch.float64))


def neighbours():
    other = jug().points + torch.tensor([0.1, 0.18, 0.0], dtype=torch.float64)
    return PointCloud(torch.cat([jug().points, other]), None, jug().viewpoint)


def towards_inside():
    away = jug().points - POSE[:3, 3]
    return PointCloud(jug().points, away / away.norm(dim=1, keepdim=True), jug().viewpoint)


REFUSED = {  # file, cloud, words of what was found, words of what mends it
    "camera frame": ("a.npz", lambda: in_camera(jug()), "camera's frame", "--up 0 -1 0"),
    "camera frame, camera not given": (
        "a.npz",
        lambda: unknown(in_camera(jug())),
        "camera's frame",
        "--camera-pose",
    ),
    "camera frame of a default PCD": (
        "a.pcd",
        lambda: pcd(in_camera(jug())),
        "camera's frame",
        "--up",
    ),
    "camera frame with a table": (
        "a.npz",
        lambda: in_camera(with_table()),
        "camera's frame",
        "normal of the plane",
    ),
    "upside down": ("a.npz", lambda: turned(jug(), *DOWN), "m below", "--up 0 0 -1"),
    "camera below": ("a.npz", mirrored, "m below", "--viewpoint"),
    "camera in the robot's base": (
        "a.npz",
        lambda: seen_from(0.0, 0.0, 0.1),
        "points contradict",
        "--no-viewpoint",
    ),
    "camera in the cloud": (
        "a.npz",
        lambda: seen_from(0.5, 0.0, 0.07),
        "points contradict",
        "--viewpoint",
    ),
    "normals away": ("a.npz", towards_inside, "point away", "--no-normals"),
    "table": ("a.npz", with_table, "a table left in", "torchgrasp cloud cut"),
    "table, no camera": (
        "a.npz",
        lambda: unknown(with_table()),
        "a table left in",
        "torchgrasp cloud cut",
    ),
    "two bodies": ("a.npz", neighbours, "two bodies", "cloud cut CLOUD --point"),
    "millimetres": ("a.npy", lambda: 1000 * jug().points.numpy(), "extent of", "--unit mm"),
    "centimetres": ("a.npy", lambda: 100 * jug().points.numpy(), "extent of", "--unit cm"),
    "whole scene": (
        "a.npy",
        lambda: 20 * jug().points.numpy(),
        "extent of",
        "torchgrasp cloud cut",
    ),
}


@pytest.fixture
def planned(monkeypatch):
    """Note what is planned with, and end there."""
    seen = []

    def note(cloud, hand, spec, *args, **kwargs):
        seen.append((cloud, spec))
        raise KeyboardInterrupt

    monkeypatch.setattr(grasps, "plan_grasps", note)
    return seen


@pytest.mark.parametrize("name", REFUSED)
def test_a_contradictory_cloud_is_refused_with_its_fix(
    name, tmp_path, run_command, refusal, planned
):
    file, make, found, fix = REFUSED[name]
    path = write(tmp_path / file, make())
    error = refusal("grasp", path, "--hand", "barrett", "--out", tmp_path / "out")
    assert error.startswith("CLOUD: ") and found in error and fix in error
    assert not planned and not (tmp_path / "out").exists()
    unit = "extent" in found
    code, out, err = run_command("cloud", "check", path)
    line = err if unit else next(s for s in out.splitlines() if s.startswith("refused"))
    assert code == (2 if unit else 1) and found in line and fix in line


SAID = {  # file, cloud, options, words of note or advice
    "as it is": ("a.npz", jug, [], ""),
    "no camera": ("a.npz", lambda: unknown(jug()), [], "--viewpoint X Y Z"),
    "a default PCD": (
        "a.pcd",
        lambda: pcd(unknown(PointCloud(moved(0.5)))),
        [],
        "the default viewpoint (0, 0, 0)",
    ),
    "NaN rows": ("a.pcd", lambda: pcd(jug()), [], "7 of 1007 rows with NaN"),
    "colours": ("a.npy", lambda: np.tile(jug().points.numpy(), 2), [], "colours?"),
    "upright by --up": ("a.npz", lambda: turned(jug(), *DOWN), ["--up", "0", "0", "-3"], ""),
    "no table": ("a.npz", mirrored, ["--no-table"], ""),
    "a part of many points": (
        "a.npy",
        lambda: np.repeat(jug().points.numpy(), 101, 0),
        [],
        "100000 of 101000 points",
    ),
}


@pytest.mark.parametrize("name", SAID)
def test_notes_and_advice_are_printed_and_the_cloud_is_planned(
    name, tmp_path, run_command, planned
):
    file, make, options, words = SAID[name]
    path = write(tmp_path / file, make())
    code, out, err = run_command(
        "grasp", path, "--hand", "barrett", "--out", tmp_path / "out", *options
    )
    assert (code, err) == (130, "torchgrasp: interrupted\n") and len(planned) == 1
    lines = [s for s in out.splitlines() if s.startswith(("note", "advice"))]
    assert any(words in s for s in lines) if words else lines == []


def test_a_surface_from_all_sides_is_refused_by_the_check_as_by_the_fit(tmp_path, capsys):
    points, _ = trimesh.sample.sample_surface(load_object("jug").mesh, 1500, seed=0)
    np.save(tmp_path / "merged.npy", np.asarray(points))
    assert cli.main(["cloud", "check", str(tmp_path / "merged.npy")]) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("refused")]
    assert (
        "which no camera sees at once: a single view, the viewpoint of each point, or outward normals"
        in line
    )
    with pytest.raises(BadArgument, match="which no camera sees at once"):
        fit_shape(read_cloud(tmp_path / "merged.npy"))


def test_shipped_views_are_never_refused(capsys):
    for name in ("cylinder", "jug"):
        assert cli.main(["cloud", "check", str(DATA / name / "view.ply")]) == 0


def test_the_camera_pose_moves_a_cloud_out_of_its_camera_s_frame(tmp_path, planned, capsys):
    write(tmp_path / "a.npz", unknown(in_camera(jug())))
    for file in ("pose.txt", "pose.npy"):
        (np.savetxt if file.endswith("txt") else np.save)(tmp_path / file, POSE.numpy())
        options = ["--camera-pose", str(tmp_path / file)]
        cli.main(
            [
                "grasp",
                str(tmp_path / "a.npz"),
                "--hand",
                "barrett",
                "--out",
                str(tmp_path / "out"),
                *options,
            ]
        )
        torch.testing.assert_close(planned[-1][0].points, jug().points)
        torch.testing.assert_close(planned[-1][0].viewpoint, POSE[:3, 3])
    assert cli.main(["cloud", "check", str(VIEW), *options]) == 2  # it is not in its camera's frame
    assert "out of a camera's sight" in capsys.readouterr().err


def test_the_vertical_and_the_table_become_a_plane(tmp_path, planned):
    write(tmp_path / "a.npz", turned(jug(), [1, 0, 0], [0, 0, 1], [0, -1, 0]))  # y up
    up = ["--up", "0", "2", "0"]
    lowest = float(remove_outliers(jug()).points[:, 2].min())
    moved = [*up, "--table", "-0.01"], ["--table", "0", "2", "0", "-0.02"]
    for options, height in zip((up, *moved), (lowest, -0.01, -0.01), strict=True):
        cli.main(
            [
                "grasp",
                str(tmp_path / "a.npz"),
                "--hand",
                "barrett",
                "--out",
                str(tmp_path / "out"),
                *options,
            ]
        )
        table = planned[-1][1].table
        assert isinstance(table, Plane) and table.normal.tolist() == [0, 1, 0]
        assert table.offset == pytest.approx(height, abs=1e-12)


BAD = "--up 0 0 0; --table 0 1; --table 0 0 0 1; --table nan; --viewpoint 0 0 1 --no-viewpoint; --camera-pose no"


@pytest.mark.parametrize("options", BAD.split("; "))
def test_bad_options_are_refused_in_one_sentence(options, refusal):
    assert refusal("cloud", "check", VIEW, *options.split()).startswith(f"{options.split()[0]}: ")


def test_cut_leaves_the_thing_at_the_point_without_the_table(tmp_path, capsys):
    mesh = load_object("jug").mesh
    box = trimesh.creation.box((0.5, 0.4, 0.01))
    box.apply_translation((0.1, 0, -0.005))
    ball = trimesh.creation.icosphere(radius=0.03)
    ball.apply_translation((0.2, 0.05, 0.03))
    scene = partial_view(trimesh.Trimesh(*stack(mesh, box, ball)), POSE, 20000)
    for name, cloud in (("z", scene), ("y", turned(scene, [1, 0, 0], [0, 0, 1], [0, -1, 0]))):
        path = str(write(tmp_path / f"{name}.npz", cloud))
        up = ["--up", "0", "1", "0"] * (name == "y")
        at = ["0.2", "0.05", "0.03"] if name == "z" else ["0.2", "0.03", "-0.05"]
        for options, wanted in (([], "jug"), (["--point", *at], "ball")):
            assert (
                cli.main(["cloud", "cut", path, "--out", str(tmp_path / "b.npz"), *up, *options])
                == 0
            )
            thing = read_cloud(tmp_path / "b.npz").points
            back = (
                ([1, 0, 0], [0, 1, 0], [0, 0, 1])
                if name == "z"
                else ([1, 0, 0], [0, 0, -1], [0, 1, 0])
            )
            points = turned(PointCloud(thing, None, thing[0]), *back).points
            of_ball = (points - torch.tensor([0.2, 0.05, 0.03]).double()).norm(dim=1) < 0.04
            assert float((of_ball == (wanted == "ball")).double().mean()) > 0.99
            assert len(thing) > 300 and float(points[:, 2].min()) < 0.03
            assert cli.main(["cloud", "check", str(tmp_path / "b.npz"), *up]) == 0
    plane = capsys.readouterr().out.split("table   --table ")[-1].split()[:4]
    assert np.allclose(np.array(plane, dtype=float), [0, 1, 0, 0], atol=0.003)
    assert (
        cli.main(["cloud", "cut", path, "--out", str(tmp_path / "c.npz"), "--box", *"778899"]) == 2
    )
    assert "0 points in the box" in capsys.readouterr().err and not (tmp_path / "c.npz").exists()


def test_scene_is_that_of_the_depth_image(tmp_path, capsys):
    image = load_scene().image
    np.save(tmp_path / "depth.npy", image.depth.numpy())
    np.savetxt(tmp_path / "pose.txt", image.obj_from_camera.numpy())
    k = image.intrinsics
    numbers = [str(float(x)) for x in (k[0, 0], k[1, 1], k[0, 2], k[1, 2])]
    words = [
        "cloud",
        "scene",
        str(tmp_path / "depth.npy"),
        "--intrinsics",
        *numbers,
        "--out",
        str(tmp_path / "s.npz"),
    ]
    assert cli.main([*words, "--camera-pose", str(tmp_path / "pose.txt")]) == 0
    found = read_scene(tmp_path / "s.npz")
    said = capsys.readouterr().out
    assert (
        len(found.things)
        == len(load_scene().things)
        == len(re.findall(r"^object ", said, re.MULTILINE))
    )
    assert found.target is None
    assert (
        found.table is not None and abs(found.table.offset) < 0.002
    )  # the shipped scene stands at z = 0
    shipped = load_scene()
    on_target = np.zeros(tuple(image.depth.shape), dtype=bool)
    on_target[tuple(shipped.pixels[shipped.rows_of(2)].T.numpy())] = True
    np.save(tmp_path / "mask.npy", on_target)
    assert (
        cli.main(
            [
                *words,
                "--camera-pose",
                str(tmp_path / "pose.txt"),
                "--mask",
                str(tmp_path / "mask.npy"),
            ]
        )
        == 0
    )
    chosen = read_scene(tmp_path / "s.npz")  # the object that was announced is still the target
    assert f"object {chosen.target}:" in capsys.readouterr().out.split("(the target)")[0]
    assert (
        float(torch.cdist(chosen.cloud().points, shipped.cloud(2).points).amin(1).quantile(0.9))
        < 0.002
    )
    np.save(tmp_path / "mask.npy", shipped.image.depth.numpy() < 0)
    assert cli.main([*words, "--mask", str(tmp_path / "mask.npy")]) == 2
    assert "--mask" in capsys.readouterr().err


def test_scene_takes_the_median_of_frames_of_a_still_camera(tmp_path, capsys):
    meshes = [box([0.06, 0.06, 0.1], (0.0, 0.0)), box([0.05, 0.08, 0.06], (0.1, 0.12))]
    poses = [look_at(20.0, 45.0, 0.7)] * 3 + [look_at(20.0, 45.0, 0.8)]
    paths = [str(tmp_path / f"{seed}.png") for seed in range(len(poses))]
    for seed, (path, pose) in enumerate(zip(paths, poses, strict=True)):
        depth = halved(render_depth(meshes, pose, noise="azure", seed=seed)[0])
        Image.fromarray(np.uint16(torch.round(1e3 * depth).numpy())).save(path)
    words = ["cloud", "scene", paths[0], "--intrinsics", "308", "308", "159.75", "119.75", "--out"]
    noise = []
    for frames in ([], ["--frames", *paths[1:3]]):
        assert cli.main([*words, str(tmp_path / "scene.npz"), *frames]) == 0
        assert "noise: " in capsys.readouterr().out
        found = read_scene(tmp_path / "scene.npz")
        assert found.things[:2] == (1, 2) and found.noise is not None
        noise.append(float(found.noise.sigma(torch.tensor(0.7))))
    assert noise[1] < 0.9 * noise[0]
    assert cli.main([*words, str(tmp_path / "moved.npz"), "--frames", *paths[1:]]) == 2
    assert (
        "--frames: expected frames of a camera and a scene that stand still"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "moved.npz").exists()
    assert cli.main([*words, str(tmp_path / "1.npz"), "--frames", paths[1]]) == 2
    assert "replace" in capsys.readouterr().err


@pytest.fixture
def square(tmp_path):
    """Words that make a scene of a plane 0.8 m away with a square 0.7 m away, but for the output."""
    depth = np.full((120, 160), 0.8)
    depth[40:80, 60:100] = 0.7
    Image.fromarray(np.uint16(np.round(1e3 * depth))).save(tmp_path / "depth.png")
    return [
        "cloud",
        "scene",
        tmp_path / "depth.png",
        "--intrinsics",
        "140",
        "140",
        "79.5",
        "59.5",
        "--out",
    ]


def test_scene_draws_a_picture_beside_it_that_replaces_no_input(
    square, tmp_path, run_command, refusal
):
    assert (
        "replace" in refusal(*square, tmp_path / "depth.npz")
        and not (tmp_path / "depth.npz").exists()
    )
    code, said, _ = run_command(*square, tmp_path / "scene.npz")
    assert code == 0 and str(tmp_path / "scene.png") in said
    with Image.open(tmp_path / "scene.png") as picture:
        assert picture.width == 1200


def test_scene_takes_the_table_the_vertical_and_a_pixel_of_the_target(
    square, tmp_path, run_command, refusal
):
    words = [*square, tmp_path / "scene.npz"]
    for options in (
        ["--table", "0", "0", "-2", "-1.6"],
        ["--up", "0", "0.1", "-1", "--point", "80", "60"],
    ):
        assert run_command(*words, *options)[0] == 0
        seen = read_scene(tmp_path / "scene.npz")
        assert seen.table is not None and abs(seen.table.offset + 0.8) < 0.001
        assert seen.target == (1 if "--point" in options else None)
    for bad in ("--table 0 1", "--table 0 0 0 1", "--up 0 0 0", "--point 5 5"):
        assert refusal(*words, *bad.split()).startswith(f"{bad.split()[0]}: expected ")


def test_a_mesh_or_a_table_that_contradicts_the_cloud_is_told_before_the_work(
    tmp_path, refusal, monkeypatch
):
    monkeypatch.setattr(
        grasps, "plan_grasps", lambda *_, **__: pytest.fail("work was done before the refusal")
    )
    mesh = load_object("jug").mesh.copy()
    mesh.apply_translation((0.13, 0.0, 0.0))
    mesh.export(tmp_path / "moved.ply")
    words = ["grasp", VIEW, "--out", tmp_path / "out", "--hand", "barrett"]
    assert "--mesh: expected the cloud's points within" in refusal(
        *words, "--mesh", tmp_path / "moved.ply"
    )
    said = refusal(*words, "--table", "0.054")
    assert (
        "above the object's foot" in said and "--table, a table under the object's points" in said
    )
    assert "foot is 54 mm above the table" in refusal(
        *words, "--table", "-0.054", "--mesh", DATA / "jug" / "mesh.ply"
    )


def test_thin_leaves_one_point_a_voxel_and_no_outliers(tmp_path, capsys):
    rng = np.random.default_rng(0).normal(size=(60000, 3))
    points = np.concatenate(
        [0.04 * rng / np.linalg.norm(rng, axis=1, keepdims=True), [[0.3, 0, 0]]]
    )
    path = str(write(tmp_path / "a.npy", points))
    assert (
        cli.main(["cloud", "thin", path, "--voxel", "0.004", "--out", str(tmp_path / "b.ply")]) == 0
    )
    thin = read_cloud(tmp_path / "b.ply").points
    assert 1000 < len(thin) < 4000 and float(thin.norm(dim=1).max()) < 0.041
    assert "1 outliers removed" in capsys.readouterr().out


def depth_image():
    """Return the depth [m] of a plane 0.5 m away with a square of pixels 0.4 m away, and the
    square's mask.
    """
    depth = np.full((480, 640), 0.5)
    mask = np.zeros((480, 640), dtype=np.uint8)
    mask[200:280, 300:380] = 255
    depth[mask > 0] = 0.4
    depth[::50] = np.nan
    return depth, mask


K = ["--intrinsics", *(str(float(INTRINSICS[i, j])) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))]


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".png"])
def test_depth_makes_a_cloud_of_the_mask(suffix, tmp_path, capsys):
    depth, mask = depth_image()
    mm = np.nan_to_num(1000 * depth).astype(np.uint16)
    path = tmp_path / f"d{suffix}"
    if suffix == ".npy":
        np.save(path, depth.astype(np.float32))
    elif suffix == ".npz":
        np.savez(path, depth=mm)
    else:
        Image.fromarray(mm).save(path)
    Image.fromarray(mask).save(tmp_path / "m.png")
    # the camera looks straight down on the plane, as on a table
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
    pose[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    np.savetxt(tmp_path / "pose.txt", pose.numpy())
    options = [*K, "--mask", str(tmp_path / "m.png"), "--out", str(tmp_path / "c.npz")]
    assert cli.main(["cloud", "depth", str(path), *options]) == 0
    still = read_cloud(tmp_path / "c.npz")
    assert len(still) == 78 * 80 and bool((still.points[:, 2] - 0.4).abs().max() < 1e-6)
    assert (
        cli.main(
            ["cloud", "depth", str(path), *options, "--camera-pose", str(tmp_path / "pose.txt")]
        )
        == 0
    )
    moved = read_cloud(tmp_path / "c.npz")
    torch.testing.assert_close(moved.points, still.points @ pose[:3, :3].T + pose[:3, 3])
    torch.testing.assert_close(moved.viewpoint, pose[:3, 3])


BAD_DEPTH = {  # depth, mask, options, words
    "mask of another size": (lambda d, m: d, lambda d, m: m[::2], [], ["--mask", "(480, 640)"]),
    "empty mask": (lambda d, m: d, lambda d, m: 0 * m, [], ["--mask", "no pixel"]),
    "intrinsics of another resolution": (
        lambda d, m: d[:240, :320],
        None,
        [],
        ["--intrinsics", "same resolution"],
    ),
    "millimetres as floats": (lambda d, m: 1000 * d, None, [], ["DEPTH", "mm"]),
    "negative": (lambda d, m: -d, None, [], ["DEPTH", "depths >= 0"]),
    "nothing measured": (
        lambda d, m: 0 * m.astype(np.uint16),
        None,
        [],
        ["DEPTH", "0 measured pixels"],
    ),
    "a picture": (lambda d, m: np.stack([d, d, d], -1), None, [], ["DEPTH", "uint16"]),
    "not a file": (None, None, [], ["DEPTH", "no file"]),
    "no pose": (lambda d, m: d, None, ["--camera-pose", "none.txt"], ["--camera-pose", "no file"]),
    "other output": (lambda d, m: d, None, ["--out", "c.pcd"], ["--out", ".npz or .ply"]),
}


@pytest.mark.parametrize("name", BAD_DEPTH)
def test_bad_depth_is_refused_in_one_sentence(name, tmp_path, refusal):
    depth, mask, options, words = BAD_DEPTH[name]
    if depth is not None:
        np.save(tmp_path / "d.npy", depth(*depth_image()))
    if mask is not None:
        np.save(tmp_path / "m.npy", mask(*depth_image()))
        options = [*options, "--mask", tmp_path / "m.npy"]
    options = options if "--out" in options else [*options, "--out", tmp_path / "c.npz"]
    error = refusal("cloud", "depth", tmp_path / "d.npy", *K, *options)
    assert (
        error.startswith(f"{words[0]}: ")
        and words[1] in error
        and not (tmp_path / "c.npz").exists()
    )


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"\x93NUMPY", b"x" * 99])
@pytest.mark.parametrize("suffix", [".png", ".npy", ".npz"])
def test_malformed_depth_files_are_refused_by_name(suffix, content, tmp_path, refusal):
    (tmp_path / f"d{suffix}").write_bytes(content)
    assert refusal(
        "cloud", "depth", tmp_path / f"d{suffix}", *K, "--out", tmp_path / "c.npz"
    ).startswith("DEPTH: ")


CAMERAS = {  # files that ROS, BOP and others write
    "info.yaml": "image_width: 640\nimage_height: 480\ncamera_matrix: {rows: 3, cols: 3, data: MATRIX}\n---\n",
    "scene_camera.json": '{"0": {"cam_K": [1, 2]}, "7": {"cam_K": MATRIX, "depth_scale": 1.0}}',
    "k.txt": "616 0 319.5\n0 616 239.5\n0 0 1\n",
}


@pytest.mark.parametrize("name", CAMERAS)
def test_intrinsics_are_read_from_a_file(name, tmp_path, run_command):
    depth, mask = depth_image()
    Image.fromarray(np.nan_to_num(1000 * depth).astype(np.uint16)).save(tmp_path / "000007.png")
    np.save(tmp_path / "m.npy", mask)
    (tmp_path / name).write_text(
        CAMERAS[name].replace("MATRIX", str([616, 0, 319.5, 0, 616, 239.5, 0, 0, 1]))
    )
    words = ["cloud", "depth", tmp_path / "000007.png", "--mask", tmp_path / "m.npy"]
    for k, out in ((K[1:], "a.npz"), ([tmp_path / name], "b.npz")):
        assert run_command(*words, "--intrinsics", *k, "--out", tmp_path / out)[0] == 0
    assert torch.equal(read_cloud(tmp_path / "a.npz").points, read_cloud(tmp_path / "b.npz").points)


BAD_CAMERAS = {
    "a.json": (b"{", "well-formed .json"),
    "b.json": (b'{"0": {"cam_K": [1]}, "1": {}}', "the entry of this image"),
    "c.yaml": (b"!!python/object/apply:os.getcwd []", "well-formed .yaml"),
    "d.yaml": (b"k: &k {k: *k}", "matrix K"),
    "e.yaml": (b"a: &a [1, 1, 1, 1]\nb: &b [*a, *a, *a, *a]\nk: [*b, *b, *b]", "matrix K"),
    "f.json": (
        b'{"K": [1232, 0, 639, 0, 1232, 479, 0, 0, 1], "width": 1280, "height": 960}',
        "all four times 0.5",
    ),
    "g.toml": (b"k = 1", ".json"),
    "word": (None, "no file"),
}


@pytest.mark.parametrize("name", BAD_CAMERAS)
def test_a_bad_file_of_intrinsics_is_refused_in_one_sentence(name, tmp_path, refusal):
    np.save(tmp_path / "d.npy", depth_image()[0])
    if BAD_CAMERAS[name][0] is not None:
        (tmp_path / name).write_bytes(BAD_CAMERAS[name][0])
    words = ["cloud", "depth", tmp_path / "d.npy", "--out", tmp_path / "c.npz"]
    error = refusal(*words, "--intrinsics", tmp_path / name)
    assert error.startswith("--intrinsics: ") and BAD_CAMERAS[name][1] in error
    assert "fx fy cx cy" in refusal(*words, "--intrinsics", "616", "616", "a", "b")


@pytest.mark.parametrize("unit", [None, "0.00025", "0.001"])
def test_a_tiff_and_its_unit_are_read(unit, tmp_path, run_command):
    depth, mask = depth_image()
    counts = np.nan_to_num(depth) / float(unit or 1)
    Image.fromarray(
        counts.astype(np.uint16) if unit == "0.00025" else counts.astype(np.float32)
    ).save(tmp_path / "d.tiff")
    np.save(tmp_path / "m.npy", mask)
    options = ["--mask", tmp_path / "m.npy", *K, *([] if unit is None else ["--depth-unit", unit])]
    assert (
        run_command("cloud", "depth", tmp_path / "d.tiff", *options, "--out", tmp_path / "c.npz")[0]
        == 0
    )
    assert np.allclose(read_cloud(tmp_path / "c.npz").points[:, 2], 0.4, atol=1e-6)


def test_exr_needs_a_package_and_a_unit_is_small(tmp_path, refusal, monkeypatch):
    (tmp_path / "d.exr").write_bytes(b"v/1\x01")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    words = ["cloud", "depth", tmp_path / "d.exr", *K, "--out", tmp_path / "c.npz"]
    assert "pip install OpenEXR" in refusal(*words)
    assert refusal(*words, "--depth-unit", "4000").startswith("--depth-unit")


def test_exr_gives_its_channel_of_depth(tmp_path, monkeypatch):
    depth = np.full((4, 6), 0.5, dtype=np.float32)
    channels = {
        "RGB": SimpleNamespace(pixels=np.zeros((4, 6, 3))),
        "View.Depth.Z": SimpleNamespace(pixels=depth),
    }
    package = SimpleNamespace(File=lambda path: SimpleNamespace(channels=lambda: channels))
    monkeypatch.setitem(sys.modules, "OpenEXR", package)
    (tmp_path / "d.exr").write_bytes(b"v/1\x01")
    assert np.array_equal(read_image_file("depth", tmp_path / "d.exr"), depth)
    channels["Other.Z"] = channels["RGB"]
    with pytest.raises(BadArgument, match="channels"):
        read_image_file("depth", tmp_path / "d.exr")


def test_a_depth_file_whose_pose_and_unit_are_not_read_says_so(tmp_path):
    depth = np.full((4, 6), 700, dtype=np.uint16)
    np.savez(tmp_path / "bare.npz", depth=depth)
    assert np.array_equal(read_image_file("depth", tmp_path / "bare.npz"), depth)
    np.savez(tmp_path / "frame.npz", depth=depth, depth_unit=0.00025, camera_pose=np.eye(4))
    with pytest.warns(NoEffect, match=r"frame\.npz: arrays camera_pose, depth_unit are not read"):
        read_image_file("depth", tmp_path / "frame.npz")


@pytest.mark.parametrize("up", [None, (0.0, 0.0, 1.0)])
def test_a_flying_pixel_below_the_table_is_not_where_the_table_is(up):
    seen = load_object("cylinder").view
    flying = PointCloud(
        torch.cat([seen.points, torch.tensor([[0.0, 0.05, -0.03]])]), viewpoint=seen.viewpoint
    )
    view = CloudOptions(up=up)
    found = [as_plane(view.plane(cloud)) for cloud in (seen, flying)]
    assert found[0].offset == found[1].offset and abs(found[0].offset) < 0.01
    assert as_plane(CloudOptions(up=up, table=(-0.03,)).plane(flying)).offset == -0.03


@pytest.mark.parametrize("suffix", [".npz", ".ply"])
def test_the_table_that_cut_names_is_that_of_the_next_commands(
    suffix, tmp_path, run_command, monkeypatch
):
    scene = str(write(tmp_path / "scene.npz", with_table(0.5)))
    cut = tmp_path / f"a{suffix}"
    thin = tmp_path / "b.npz"
    words = run_command("cloud", "cut", scene, "--out", cut)[1].split("table   --table ")[1].split()
    named = [float(word) for word in words[:4]]
    assert str(cut) in " ".join(words)
    assert run_command("cloud", "thin", cut, "--out", thin)[0] == 0
    planned = []
    monkeypatch.setattr(
        grasps,
        "plan_grasps",
        lambda cloud, hand, spec, *_, **__: planned.append(spec.table) or exit(9),
    )
    for path, options, offset in (
        (cut, [], named[3]),
        (thin, [], named[3]),
        (cut, ["--table", "-0.02"], -0.02),
    ):
        planned.clear()
        assert "the file holds a table" in run_command("cloud", "check", path)[1]
        with pytest.raises(SystemExit):
            run_command("grasp", path, "--out", tmp_path / "out", "--hand", "barrett", *options)
        assert abs(as_plane(planned[0]).offset - offset) < 1e-4
    file = read_cloud_file(cut)
    assert file.table is not None and np.allclose(
        [*file.table.normal.tolist(), file.table.offset], named, atol=1e-4
    )
    np.savetxt(tmp_path / "pose.txt", np.diag([1.0, -1.0, -1.0, 1.0]))
    moved = ViewOptions(camera_pose=tmp_path / "pose.txt", unit="mm").read(
        "CLOUD",
        save_cloud(
            PointCloud(100 * torch.rand(50, 3) + torch.tensor([0, 0, 900.0])),
            thin,
            Plane.horizontal(7.0),
        ),
    )
    assert moved.table is not None and np.allclose(
        [*moved.table.normal.tolist(), moved.table.offset], [0, 0, -1, 0.007]
    )


def test_a_cloud_gives_a_scene_as_its_depth_image_does(tmp_path, run_command):
    meshes = [box([0.06, 0.06, 0.1], (0.0, 0.0)), box([0.05, 0.08, 0.06], (0.1, 0.12))]
    pose = look_at(40.0, 45.0, 0.7)
    depth = halved(render_depth(meshes, pose)[0])
    k = HALF
    camera = Scene.from_depth(depth, k)
    rows = torch.where(
        (depth > 0)[..., None], DepthImage(depth, k, torch.eye(4).double()).points(), torch.nan
    )
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 320\nHEIGHT 240\nVIEWPOINT 0 0 0 1 0 0 0\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(head.encode() + rows.numpy().astype("<f4").tobytes())
    seen = PointCloud(camera.points, None, torch.zeros(3).double())
    save_cloud(seen, tmp_path / "b.ply")
    save_cloud(PointCloud(1000 * seen.points), tmp_path / "c.npz")
    np.savetxt(tmp_path / "pose.txt", pose.numpy())
    point = camera.cloud(2).points[0].tolist()
    for name, options in (
        ("a.pcd", []),
        ("a.pcd", ["--point", *point]),
        ("b.ply", ["--up", *pose[2, :3].tolist()]),
        ("c.npz", ["--unit", "mm", "--viewpoint", 0, 0, 0]),
        ("b.ply", ["--camera-pose", tmp_path / "pose.txt"]),
    ):
        code, said, error = run_command(
            "cloud", "scene", tmp_path / name, *options, "--out", tmp_path / "s.npz"
        )
        found = read_scene(tmp_path / "s.npz")
        assert code == 0 and "object 2" in said, error
        assert (
            len(found.things) == len(camera.things)
            and not found.image.bounded
            and (tmp_path / "s.png").is_file()
        )
        assert (found.target is not None) == ("--point" in options)
        height = found.table.height(found.viewpoint) if found.table is not None else 0
        assert abs(float(height) - float(pose[2, 3])) < 0.004


NO_SCENE = {
    "an image without intrinsics": ("d.png", [], "--intrinsics: expected fx fy cx cy"),
    "a scene's file": ("e.npz", [], "--intrinsics: expected fx fy cx cy"),
    "a cloud without a camera": (
        "f.npy",
        [],
        "--viewpoint: expected the position of the one camera",
    ),
    "a mask": ("f.npy", ["--mask", "m.png"], "--mask: expected --point"),
    "a unit of depth": ("f.npy", ["--depth-unit", "0.001"], "--depth-unit: expected"),
    "a pixel": ("f.npy", ["--point", "3", "4"], "--point: expected x y z"),
    "no cloud": ("g.pcd", [], "DEPTH: expected a well-formed .pcd file"),
    "a viewpoint of an image": (
        "d.png",
        [*K, "--viewpoint", "0", "0", "0"],
        "--intrinsics: expected --camera-pose",
    ),
}


@pytest.mark.parametrize("name", NO_SCENE)
def test_a_cloud_that_gives_no_scene_is_refused_in_one_sentence(name, tmp_path, refusal):
    file, options, words = NO_SCENE[name]
    Image.fromarray(np.ones((9, 9), dtype=np.uint16)).save(tmp_path / "d.png")
    np.savez(tmp_path / "e.npz", depth=np.ones((9, 9)), intrinsics=np.eye(3))
    np.save(tmp_path / "f.npy", np.random.default_rng(0).random((90, 3)))
    (tmp_path / "g.pcd").write_bytes(b"x")
    assert refusal(
        "cloud", "scene", tmp_path / file, *options, "--out", tmp_path / "s.npz"
    ).startswith(words)


def test_normals_without_a_camera_are_planned_and_the_check_says_so(tmp_path, capsys):
    """Of one view the check and the planner estimate the camera; a whole surface has none."""
    seen = estimate_normals(load_object("jug").view)
    save_cloud(PointCloud(seen.points, seen.normals), path := tmp_path / "normals.npz")
    assert cli.main(["cloud", "check", str(path)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"viewpoint +estimated, .*100% of the normals", said) and "refused" not in said
    assert fit_shape(read_cloud(path)).kind != "whole"
    ball = torch.nn.functional.normalize(
        torch.randn(600, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    assert diagnose_cloud(PointCloud(0.04 * ball, ball)).viewpoint is None


@pytest.mark.parametrize(("factor", "name"), [(1000.0, "mm"), (100.0, "cm"), (20.0, "")])
def test_a_pose_of_a_cloud_that_is_not_in_metres_is_told(tmp_path, factor, name):
    pose = POSE.numpy().copy()
    pose[:3, 3] = factor * np.array([0.9, 0.4, 0.6])
    np.savetxt(tmp_path / "pose.txt", pose)
    path = write(tmp_path / "a.npz", in_camera(jug()))
    options = ViewOptions(camera_pose=tmp_path / "pose.txt")
    if name:
        with pytest.raises(BadArgument, match=f"--camera-pose: .* in {name}, divide"):
            options.read("CLOUD", path)
    else:
        (note,) = options.read("CLOUD", path).notes
        assert "22.9 m from the origin" in note or "23.1 m from the origin" in note


def test_an_object_far_above_its_table_is_told():
    for table, told in ((0.0, False), (-0.02, False), (-0.08, True), (-13.0, True)):
        advice = diagnose_cloud(jug(), table=Plane.horizontal(table)).advice
        found = [one for one in advice if "above its table" in one.found]
        assert bool(found) == told and not any(one.refused for one in found)
    assert not diagnose_cloud(jug(), stands=False).advice


def test_a_box_of_hundreds_of_metres_is_told(capsys):
    assert read_region("--keep", "-0.1 -0.1 0.05 0.1 0.1 0.2") is not None
    assert capsys.readouterr().out == ""
    assert read_region("--keep", "-70 -40 5 50 50 160") is not None
    assert "--keep: a box of 120 x 90 x 155 m" in capsys.readouterr().out
