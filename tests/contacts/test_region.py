"""Regions: signed distances against sampled borders and another library's, masks against the pixels
that they mark.
"""

import numpy as np
import pytest
import torch
import trimesh

from tests.make import random_motion, real, see
from torchgrasp import ContactSpec, Region, Status, fit_shape, load_object, plan_contacts
from torchgrasp.contacts.problem import ContactProblem
from torchgrasp.contacts.region import combine
from torchgrasp.foundation.errors import BadArgument, MeshError
from torchgrasp.geometry.frames import apply

LOW = real([-0.03, -0.02, 0.01])
HIGH = real([0.05, 0.04, 0.06])


def test_a_box_and_a_mesh_have_the_distance_of_a_sampled_border_and_the_sign_of_the_corners(
    generator,
):
    pose = random_motion(3)
    mesh = trimesh.creation.box(bounds=np.stack([LOW.numpy(), HIGH.numpy()])).apply_transform(
        pose.numpy()
    )
    border = torch.from_numpy(trimesh.sample.sample_surface(mesh, 50_000, seed=0)[0])
    local = LOW + (HIGH - LOW) * (
        2 * torch.rand(200, 3, generator=generator, dtype=torch.float64) - 0.5
    )
    points = apply(pose, local)
    inside = ((local > LOW) & (local < HIGH)).all(1)
    for region in (Region.box(LOW, HIGH, pose), Region.mesh(mesh)):
        found = region(points)
        assert torch.equal(found < 0, inside)
        beyond = torch.cdist(points, border).amin(1) - found.abs()
        assert (
            -1e-9 < float(beyond.min()) and float(beyond.max()) < 1e-3
        )  # samples lie farther than the border
    assert Region.box(LOW, HIGH)(torch.zeros(2, 5, 3)).shape == (2, 5)  # and keeps the dtype
    assert Region.box(LOW, HIGH)(torch.zeros(3)).dtype == torch.float32


def test_a_mask_is_the_cone_of_its_pixels_with_the_unseen_side():
    scene = see((0.0, 0.0, 0.06, 0.12), (0.0, -0.1, 0.06, 0.14))
    region = Region.mask(scene, scene.pixel_labels == 1)
    camera = scene.viewpoint.double()
    seen = scene.points.double()
    own = scene.labels == 1
    assert torch.equal(region(seen) < 0, own)
    assert torch.equal(region(camera + 1.4 * (seen - camera)) < 0, own)  # behind it
    some = seen[~own][::200]
    gap = torch.cdist(some, seen[own]).amin(1)
    assert bool((region(some) <= gap + 1e-3).all())  # the cone is nowhere farther than its seen end
    with pytest.raises(BadArgument, match="mask"):
        Region.mask(scene, torch.ones(3, 3, dtype=torch.bool))


def test_regions_combine_and_tell_what_is_no_region():
    ball = Region(lambda x: x.norm(dim=-1) - 0.05)
    box = Region.box(LOW, HIGH)
    points = real([[0.0, 0, 0], [0.0, 0, 0.03], [0.0, 0, 0.09]])
    both = combine(ball, box)
    assert both is not None and (both(points) < 0).tolist() == [True, False, False]
    assert combine(None, None) is None
    for wrong in (lambda x: x, lambda x: x[:, 0] / 0, lambda x: 3.0):
        with pytest.raises(BadArgument, match="distance"):
            Region(wrong)(points)
    with pytest.raises(BadArgument, match="low"):
        Region.box(HIGH, LOW)
    opened = trimesh.creation.box(extents=[0.1, 0.1, 0.1])
    opened.update_faces(np.arange(12) > 0)
    with pytest.raises(MeshError):
        Region.mesh(opened)


def test_the_row_of_a_region_is_its_distance_with_its_gradient(ellipsoid, generator):
    centre = real([0.3, 0.1, -0.2])
    spec = ContactSpec(region=lambda x: (x - centre).norm(dim=-1) - 0.1)
    problem = ContactProblem.of(ellipsoid, spec)
    points = 0.8 * torch.randn(6, 3, 3, generator=generator, dtype=torch.float64)
    value, slope = problem._outside(points)
    x = points.clone().requires_grad_()
    wanted = ((ellipsoid.metres(x) - centre).norm(dim=-1) - 0.1) / ellipsoid.scale
    (gradient,) = torch.autograd.grad(wanted.sum(), x)
    torch.testing.assert_close(value, wanted.detach())
    torch.testing.assert_close(slope, gradient, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("spec", [ContactSpec(table=0.0), ContactSpec.paper()])
def test_planned_contacts_lie_in_the_region_or_say_so(spec):
    view = load_object("jug").view
    region = Region.rim(view, 0.0, 0.4)
    shape = fit_shape(view, table=0.0)
    inside = ContactSpec(**vars(spec) | {"region": region})
    free, kept = (plan_contacts(shape, one, 30) for one in (spec, inside))
    good = kept.status == Status.OK
    assert bool((region(kept.contacts.points[good]) < 0).all()) and int(good.sum()) > 10
    beyond = (region(free.contacts.points) > 0).any(1) & (free.status == Status.OK)
    assert int(beyond.sum()) > 10  # the region is no matter of course
    missed = plan_contacts(
        shape, ContactSpec(**vars(spec) | {"region": lambda x: x[:, 2] + 1.0}), 20
    )
    assert not bool((missed.status == Status.OK).any())
    assert int((missed.status == Status.OUTSIDE).sum()) > 10
