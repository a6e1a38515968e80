"""The benchmarks' own oracles agree with the library: what they call identical is."""

from functools import partial
from pathlib import Path

import pytest
import torch

from torchgrasp.shape.kernel import covariance, thin_plate
from torchgrasp.shape.profiles import kernel_by_name
from torchgrasp.shape.select import select_points

SCRIPTS = str(Path(__file__).resolve().parents[1] / "scripts")


@pytest.fixture
def scripts(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)


@pytest.mark.parametrize("rows", [True, False])
@pytest.mark.parametrize("columns", [True, False])
def test_the_closed_form_of_the_peers_is_the_covariance(scripts, generator, rows, columns):
    from benchmarks.common import random_view
    from benchmarks.peers import thin_plate_rows

    x, _ = random_view(30, generator)
    masks = [torch.full((30,), yes) for yes in (rows, columns)]
    expected = covariance(x, x, *masks, partial(thin_plate, psi=3.0))
    torch.testing.assert_close(thin_plate_rows(x, x, 3.0, rows, columns), expected, rtol=0, atol=1e-13)


def test_the_selection_picks_what_a_refit_for_each_pick_does(scripts, generator):
    from benchmarks.common import random_view
    from benchmarks.exact import observe_support
    from benchmarks.peers import select_by_refitting

    x, normals = random_view(120, generator)
    known = observe_support(x)
    found = select_points(x, normals, known, kernel_by_name("thin_plate", 3.6), 40, 0.01, 0.05)
    assert torch.equal(found.picks, select_by_refitting(x, known, 40, 3.6, 0.01, 0.05))


@pytest.mark.parametrize("body", ["ellipsoid", "box", "cylinder", "torus"])
def test_a_random_view_has_unit_normals_that_face_one_side(scripts, generator, body):
    from benchmarks.common import random_view

    x, normals = random_view(200, generator, body)
    assert x.shape == normals.shape == (200, 3)
    assert float(torch.linalg.vector_norm(x, dim=-1).max()) == pytest.approx(1.0)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(200, dtype=torch.float64))
    assert float(torch.linalg.vector_norm(normals.mean(0))) > 0.3


def test_a_row_says_whether_its_bar_is_met(scripts):
    from benchmarks.common import Row

    assert [str(Row("a", "b", "c", met, {})).split()[0] for met in (True, False, None)] == ["met", "MISSED", "-"]
