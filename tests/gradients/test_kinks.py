"""Derivatives where a norm, a ratio or a choice meets its kink: all finite, or the row refused."""

import pytest
import torch
from torch import Tensor
from torch.func import jvp

from tests.gradients.compare import F64, weighted_sum
from tests.gradients.kinks import SIZE, places_of, ring
from tests.gradients.table import LAW, ROWS, outputs, shape_of
from tests.make import near, real
from torchgrasp import Contacts, ContactSpec, certify
from torchgrasp.contacts.certify import bound_margin
from torchgrasp.contacts.form_closure import wrenches
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.planning import Certificate

ALL = {**ROWS, **LAW}


def known(found: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """Return results with those masked that are no number: the value of such a row is refused."""
    return tuple(torch.where(y.isfinite(), y, 0.0) for y in found)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.filterwarnings("ignore")  # torch warns of its own forward mode
def test_derivatives_at_kinks_are_finite_or_the_row_is_refused(
    name: str, request: pytest.FixtureRequest
):
    long = request.config.getoption("--hypothesis-profile") == "long"
    if "HollowShape" in name and not name.endswith("predict") and not long:
        pytest.skip("its code is that of another row")
    row = ALL[name]
    function, inputs = row.make(F64)
    tried = 0
    for number, x in enumerate(places_of(name)(inputs)):
        x = tuple(v.clone(memory_format=torch.contiguous_format) for v in x)
        leaves = tuple(v.clone().requires_grad_() for v in x)
        try:
            total = weighted_sum(known(outputs(function(*leaves))))
        except BadArgument:
            continue
        tried += 1
        slopes = torch.autograd.grad(
            total, leaves, create_graph=row.order > 1, materialize_grads=True
        )
        found = [*slopes]
        if row.order > 1 and any(slope.requires_grad for slope in slopes):
            twice = sum(slope.sum() for slope in slopes)
            assert isinstance(twice, Tensor)
            found += torch.autograd.grad(twice, leaves, materialize_grads=True)
        ways = tuple(map(torch.ones_like, x))
        found += known(jvp(lambda *v: outputs(function(*v)), x, ways)[0])
        found += jvp(lambda *v: known(outputs(function(*v))), x, ways)[1]
        assert all(bool(v.isfinite().all()) for v in found), number
    assert tried


def certified(points: Tensor, normals: Tensor) -> tuple[Certificate, Tensor]:
    """Return a certificate and the derivative of its margin by the points."""
    points = points[None].clone().requires_grad_()
    found = certify(Contacts(points, normals[None]))
    (slope,) = torch.autograd.grad(found.margin.sum(), points)
    return found, slope


@pytest.mark.parametrize("count", [3, 4, 5])
@pytest.mark.parametrize("turn", [0.0, 0.3, 1.7])
def test_the_greatest_margin_has_a_derivative_of_zero_and_a_witness(count: int, turn: float):
    """No margin is greater than 1 over the number of edges, and regular figures reach it."""
    corners = ring(count, turn)
    found, slope = certified(corners, corners / SIZE)
    spec = ContactSpec()
    greatest = 1 / (count * spec.edges)
    near(found.margin.detach(), real([greatest]), 1e-12)
    assert bool(found.closed) and not bool(slope.any())
    near(found.witness.norm(dim=-1), real([1.0]), 1e-12)
    edges = wrenches(corners[None], corners[None] / SIZE, spec.planned_friction, spec.edges)
    near(bound_margin(edges.flatten(1, 2), found.witness), real([greatest]), 1e-12)


def test_a_micrometre_from_the_greatest_margin_the_derivative_is_that_of_one_side(generator):
    corners = ring(3)
    noise = 1e-6 * torch.randn(corners.shape, generator=generator, dtype=F64, device="cpu")
    found, slope = certified(corners + noise, corners / SIZE)
    step = 1e-9 * slope / slope.norm()
    higher = certify(Contacts((corners + noise)[None] + step, corners[None] / SIZE)).margin
    near((higher - found.margin.detach()) / 1e-9, slope.norm()[None], 1e-3 * float(slope.norm()))


def test_a_masked_set_without_a_margin_spoils_no_derivative():
    corners = ring(3)
    up = real([0.0, 0.0, 1.0]).expand(3, 3)
    points = corners.clone().requires_grad_()
    moved = points + real([0.0, 0.001, 0.0]) * real([[1.0], [0.0], [0.0]])
    both = certify(Contacts(torch.stack([moved] * 2), torch.stack([corners / SIZE, up]))).margin
    assert both[1] == -torch.inf
    slope = torch.autograd.grad(both[both.isfinite()].sum(), points)[0]
    assert bool(slope.isfinite().all()) and bool(slope.any())


def test_samples_at_points_that_coincide_move_with_them():
    """Two points in one place that move together have the samples of a single point that moves."""
    shape = shape_of()
    at = shape.metres(real([[0.5, 0.3, -0.2]]))
    once = jvp(lambda p: shape.sample(p, 3), (at,), (torch.ones_like(at),))
    twice = jvp(lambda p: shape.sample(p.expand(2, 3), 3), (at,), (torch.ones_like(at),))
    for value in (*once, *twice):
        assert bool(value.isfinite().all())
    near(twice[0][:, 0], twice[0][:, 1], 1e-5)
    near(twice[1][:, 0], twice[1][:, 1], 1e-5 * float(twice[1].abs().max()))
    still = shape.sample(at.expand(2, 3), 3)
    near(twice[0], still, 1e-5)


def test_a_weight_of_zero_leaves_the_density_of_the_others():
    function, (x, means, root, _) = ROWS[
        "torchgrasp.posture_model.gaussian.GaussianMixture.log_prob"
    ].make(F64)
    logits = real([0.0, -1e4]).requires_grad_()
    value = function(x, means, root, logits)
    (slope,) = torch.autograd.grad(value.sum(), logits)
    assert bool(value.isfinite().all()) and not bool(slope.any())
