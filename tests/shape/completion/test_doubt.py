"""What a view does not tell: it warns where the view is cut off, flat, sparse, has a gap, or shows
two bodies.
"""

import dataclasses
import math
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from tests.make import real
from torchgrasp import cloud_from_depth, fit_shape
from torchgrasp.cloud import look_at, partial_view
from torchgrasp.cloud.diagnose import diagnose_cloud
from torchgrasp.foundation.errors import CutOff, FewPoints, Flat, Gap, TwoBodies
from torchgrasp.shape.completion.silhouette import silhouettes
from torchgrasp.values.planning import PointCloud

PATH = {"PYTHONPATH": str(Path(__file__).parents[3])}


def on_table(mesh):
    return mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])


def surface(mesh, n=2000):
    return torch.from_numpy(np.asarray(trimesh.sample.sample_surface(mesh, n, seed=0)[0]))


BOX = on_table(trimesh.creation.box([0.08, 0.06, 0.12]))
CAN = on_table(trimesh.creation.cylinder(0.04, 0.14))


def cut_view(mesh, beyond):
    """A view of which the image ends at a plane through the camera and x = y = 0 there, `beyond` m
    to the side.
    """
    whole = partial_view(mesh, look_at(0.0, 20.0, target=mesh), n=1000, noise=False)
    ray = real([0.0, beyond, 0.07]) - whole.viewpoint
    side = real([0.0, -1.0, 0.0])
    side = side - (side @ ray) / (ray @ ray) * ray
    sides = torch.stack([side, ray, ray, ray])
    inside = (whole.points - whole.viewpoint) @ side > 0
    return dataclasses.replace(
        whole.select(inside), frustum=sides / sides.norm(dim=1, keepdim=True)
    )


def test_beyond_the_border_of_the_image_the_shape_is_told_to_be_a_guess():
    cloud = cut_view(CAN, 0.01)
    truth = surface(CAN)
    with pytest.warns(CutOff, match="cuts the object off"):
        told = fit_shape(cloud, table=0.0)
    untold = fit_shape(dataclasses.replace(cloud, frustum=None), table=0.0)
    shares = []
    for shape in (told, untold):
        estimate = shape.predict(truth[truth[:, 1] > 0.013])
        shares.append(
            float(((estimate.distance * shape.scale).abs() < 2 * estimate.std_m).double().mean())
        )
    assert shares[0] > 0.8 > 0.5 > shares[1]
    seen = told.predict(cloud.points)
    assert float((seen.distance * told.scale).abs().median()) < 0.001


def test_a_depth_image_that_ends_on_the_object_cuts_it_off_and_a_whole_one_does_not():
    pose = look_at(30.0, 25.0, target=BOX)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = partial_view(BOX, pose, n=600)
        shape = fit_shape(whole, table=0.0)
    assert whole.frustum is not None and shape.std_factor < 1.0
    size = 120
    focal = 300.0
    v, u = torch.meshgrid(torch.arange(size).double(), torch.arange(size).double(), indexing="ij")
    ball = 0.5 + 0.0 * u
    radius = torch.hypot(u - 20, v - 60) / focal * 0.5
    mask = radius < 0.06
    depth = torch.where(mask, ball - torch.sqrt((0.06**2 - radius**2).clamp_min(0)), 0.0)
    cloud = cloud_from_depth(depth, (focal, focal, size / 2, size / 2))
    with pytest.warns(CutOff):
        fit_shape(cloud.select(torch.arange(0, len(cloud), 8)))


def test_a_gap_in_a_face_is_neither_a_hole_nor_a_sure_surface():
    view = partial_view(BOX, look_at(30.0, 25.0, target=BOX), n=1000)
    face = real([0.04, 0.0, 0.06])
    away = torch.linalg.vector_norm(view.points - face, dim=1)
    with pytest.warns(Gap, match="a gap of 3. mm"):
        shape = fit_shape(view.select(away > 0.02), table=0.0)
    angle = torch.linspace(0, 2 * math.pi, 9).double()[:-1]
    ring = face + 0.012 * torch.stack([torch.zeros_like(angle), angle.cos(), angle.sin()], -1)
    inside = shape.predict(torch.cat([face[None], ring]))
    assert bool(((inside.distance * shape.scale).abs() < inside.std_m).all())
    sure = shape.predict(view.points[away > 0.03])
    assert float(inside.std_m.median()) > 1.5 * float(sure.std_m.median())


def test_a_hole_that_is_seen_through_is_no_surface_and_two_bodies_are_told():
    ring = on_table(trimesh.creation.torus(0.04, 0.012))
    with pytest.warns(Gap):
        shape = fit_shape(partial_view(ring, look_at(30.0, 60.0, target=ring), n=1000), table=0.0)
    middle = shape.predict(real([[0.0, 0.0, 0.012], [0.01, 0.0, 0.012]]))
    assert bool((middle.distance * shape.scale > 0.01).all())
    other = trimesh.creation.box([0.05, 0.05, 0.06])
    other.apply_translation([0.0, 0.13, 0.03])
    both = trimesh.util.concatenate([BOX, other])
    with pytest.warns(TwoBodies, match="two bodies that stand apart"):
        fit_shape(partial_view(both, look_at(30.0, 40.0, target=both), n=1000), table=0.0)


def test_a_gap_that_is_far_wider_than_the_bars_around_it_is_a_hole_and_a_gap_in_a_face_is_none():
    ring = on_table(trimesh.creation.torus(0.04, 0.004))
    hole = silhouettes(partial_view(ring, look_at(30.0, 60.0, target=ring), n=1000))
    assert 0.020 < float(hole.hull_distance(real([0.0, 0.0, 0.004]))) < 0.036 and hole.gap > 0.04
    view = partial_view(BOX, look_at(30.0, 25.0, target=BOX), n=1000)
    face = real([0.04, 0.0, 0.06])
    patch = silhouettes(view.select(torch.linalg.vector_norm(view.points - face, dim=1) > 0.02))
    assert float(patch.hull_distance(face)) < -0.02 and patch.gap > 0.025


@pytest.mark.parametrize("noise", [False, True])
def test_one_face_is_told_to_be_flat_and_two_faces_are_not(noise):
    with pytest.warns(Flat, match="lie in one plane"):
        fit_shape(partial_view(BOX, look_at(0.0, 0.0, target=BOX), n=1000, noise=noise), table=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit_shape(partial_view(BOX, look_at(0.0, 20.0, target=BOX), n=1000, noise=noise), table=0.0)
        fit_shape(partial_view(CAN, look_at(0.0, 0.0, target=CAN), n=100, noise=noise), table=0.0)


def test_a_cloud_of_few_points_is_told():
    few = partial_view(CAN, look_at(0.0, 20.0, target=CAN), n=99)
    assert any("too few for a shape" in str(text) for text in diagnose_cloud(few).advice)
    with pytest.warns(FewPoints, match="^99 points"):
        fit_shape(few, table=0.0)


def test_a_warning_names_the_line_of_the_caller(tmp_path):
    """In a process of its own: here the checks of annotations stand between caller and library."""
    lines = [
        "import torch",
        "from torchgrasp import PointCloud, fit_shape, load_object",
        "view = load_object('cylinder').view",
        "both = torch.cat([view.points, view.points + torch.tensor([0.0, 0.25, 0.0])])",
        "fit_shape(PointCloud(both, viewpoint=view.viewpoint), table=0.0)",
    ]
    script = tmp_path / "script.py"
    script.write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, env=os.environ | PATH
    )
    assert f"{script}:5: TwoBodies: two bodies" in done.stderr


@pytest.mark.parametrize("azimuth", [0.0, 45.0])
def test_without_a_given_camera_lost_rims_are_less_excluded(azimuth):
    brick = on_table(trimesh.creation.box([0.05, 0.09, 0.05]))
    pose = look_at(azimuth, 30.0, target=brick)
    points = partial_view(brick, pose, n=100_000).points
    # a real camera loses the end of the brick, which its outline then leaves out
    points = points[points[:, 1] < 0.035]
    truth = surface(brick)
    end = truth[(truth[:, 1] > 0.0449) & (truth[:, 2] > 0.005)]
    error = []
    within = []
    for camera in (None, pose[:3, 3].to(points)):
        shape = fit_shape(PointCloud(points, viewpoint=camera), table=0.0)
        seen = shape.predict(end)
        away = (seen.distance * shape.scale).abs()
        error.append(float(away.median()))
        within.append(float((away < 2 * seen.std_m).double().mean()))
    assert within[0] > within[1] and within[0] > 0.5
    assert error[0] < error[1] + 0.001
