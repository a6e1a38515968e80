"""Derivatives at the edges: parameters that an optimiser changes, rows that are not finite,
verdicts that have none.
"""

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.func import grad, jvp, vmap

from tests.make import near, real
from torchgrasp import Contacts, certify, encode, load_mixture
from torchgrasp.control import squeeze
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import virtual_frame
from torchgrasp.geometry.linalg import cholesky, unit
from torchgrasp.hand.load import load_hand
from torchgrasp.posture_model import GaussianMixture

TRIANGLE = real([[[1.0, 0, 0], [-0.5, 0.8, 0.1], [-0.5, -0.8, 0]]])


def two(means: Tensor, root: Tensor, logits: Tensor) -> GaussianMixture:
    return GaussianMixture(torch.softmax(logits, 0), means, root @ root.mT, ("a", "b"))


def test_a_mixture_is_fitted_by_gradient(generator):
    """Two clouds of points; the density of the points grows, and the means end at the clouds."""
    centres = real([[3.0, 0.0], [-3.0, 1.0]])
    points = centres.repeat(40, 1) + 0.3 * torch.randn(
        80, 2, generator=generator, dtype=torch.float64
    )
    free = [
        real([[1.0, 0], [-1, 0]]),
        torch.eye(2, dtype=torch.float64).repeat(2, 1, 1),
        real([0.5, -0.5]),
    ]
    optimiser = torch.optim.Adam([x.requires_grad_() for x in free], lr=0.2)
    for _ in range(80):
        optimiser.zero_grad()
        (-two(*free).log_prob(points).mean()).backward()
        optimiser.step()
    near(free[0].detach(), torch.stack([points[::2].mean(0), points[1::2].mean(0)]), 0.05)
    near(torch.softmax(free[2].detach(), 0), real([0.5, 0.5]), 0.05)


def test_what_a_mixture_keeps_is_dropped_when_a_parameter_becomes_free(generator):
    shipped = load_mixture("barrett")
    mixture = dataclasses.replace(shipped, means=shipped.means.clone())
    x = shipped.means[:3] + 0.01
    before = mixture.log_prob(x)
    mixture.means.requires_grad_()
    (slope,) = torch.autograd.grad(mixture.log_prob(x).sum(), mixture.means)
    wanted = grad(lambda means: dataclasses.replace(shipped, means=means).log_prob(x).sum())(
        shipped.means
    )
    near(slope, wanted, 1e-9)
    assert bool(slope.any())
    with torch.no_grad():  # an optimiser's step
        mixture.means.add_(0.01)
        assert not torch.allclose(mixture.log_prob(x), before)
    with pytest.raises(BadArgument, match="means"):
        mixture.sample(3)


def test_codes_that_are_not_finite_spoil_no_gradient_of_parameters_or_of_other_codes():
    shipped = load_mixture("barrett")
    q = shipped.means[:3, -6:].clone()
    q[1, 2] = torch.nan
    for name in ("energy", "joints"):

        def total(means: Tensor, q: Tensor, name: str = name) -> Tensor:
            return (
                getattr(dataclasses.replace(shipped, means=means), name)(q + 0.01)
                .nan_to_num()
                .sum()
            )

        found = grad(total, (0, 1))(shipped.means, q)
        near(found[0], grad(total)(shipped.means, q[[0, 2]]), 1e-9)
        assert bool((found[1][1] == 0).all()) and bool(found[1][0].any())


def test_contacts_on_a_line_spoil_no_gradient_of_other_codes(generator):
    points = torch.cat([TRIANGLE, 0 * TRIANGLE, 1.5 * TRIANGLE])
    slope = grad(
        lambda p: encode((p, unit(TRIANGLE).repeat(3, 1, 1))).q.nan_to_num().square().sum()
    )(points)
    assert bool(slope.isfinite().all()) and bool((slope[1] == 0).all()) and bool(slope[2].any())


def margin(points: Tensor, field: str = "margin") -> Tensor:
    return getattr(certify(Contacts(points, unit(points))), field)


def test_the_margin_grows_along_its_gradient_and_bad_rows_spoil_no_other(generator):
    points = TRIANGLE + 0.1 * torch.randn(20, 3, 3, generator=generator, dtype=torch.float64)
    slope = grad(lambda p: margin(p).sum())(points)
    step = 1e-5 * unit(slope.flatten(1)).view_as(slope)
    assert bool((margin(points + step) > margin(points)).all())
    spoilt = torch.cat([points, torch.full_like(points[:1], torch.nan)])
    near(grad(lambda p: margin(p)[:-1].sum())(spoilt)[:-1], slope, 1e-12)


@pytest.mark.filterwarnings("ignore")  # torch warns of its own forward mode
def test_other_fields_of_a_certificate_and_forces_have_no_derivative():
    for field in ("rank_ratio", "residual", "witness"):
        with pytest.raises(BadArgument, match="margin"):
            margin(TRIANGLE.clone().requires_grad_(), field).sum().backward()
        assert bool(
            jvp(lambda p, field=field: margin(p, field), (TRIANGLE,), (TRIANGLE,))[1].isnan().all()
        )
    assert not margin(TRIANGLE.clone().requires_grad_(), "closed").requires_grad
    hand = load_hand("barrett")
    grasps = load_shipped_grasp("jug", "barrett")
    moved: dict[str, Any] = {
        "contacts": dataclasses.replace(grasps.contacts, points=tracked(grasps.contacts.points))
    }
    for name, value in (moved | {"obj_from_hand": tracked(grasps.obj_from_hand)}).items():
        with pytest.raises(BadArgument, match=f"grasps.{name}"):
            squeeze(hand, dataclasses.replace(grasps, **{name: value}))


def tracked(x: Tensor) -> Tensor:
    return x.clone().requires_grad_()


def test_inside_vmap_degenerate_contacts_and_indefinite_matrices_give_nan():
    frames = vmap(virtual_frame)(torch.cat([TRIANGLE, 0 * TRIANGLE]))
    near(frames[0], virtual_frame(TRIANGLE[0]), 1e-12)
    assert bool(frames[1, :3].isnan().any()) and bool(frames[0].isfinite().all())
    factors = vmap(lambda x: cholesky(x, "a matrix", "none"))(
        torch.stack([torch.eye(2), -torch.eye(2)])
    )
    assert bool(factors[1].isnan().all()) and torch.equal(factors[0], torch.eye(2))
