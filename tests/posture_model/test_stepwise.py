"""EM on nested random subsets: what the subsets hold, and fits beside full-batch EM and
scikit-learn.
"""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
import torch
from sklearn.mixture import GaussianMixture

from tests.make import ring_samples as ring
from torchgrasp import GraspMixture, fit_mixture
from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.posture_model.em import DataRows, FitProgress
from torchgrasp.posture_model.stepwise import Subsets, halves

STATE = {"weights", "means", "covariances", "reseeded", "log_likelihood", "centre", "scale"}
"""The tensors of a checkpoint."""


@dataclasses.dataclass(frozen=True)
class Part(DataRows):
    """The share of one process, which knows the lengths of all shares."""

    all_lengths: tuple[int, ...] = ()

    def count(self) -> int:
        return sum(self.all_lengths)

    def lengths(self) -> torch.Tensor:
        return torch.tensor(self.all_lengths)


def parameters(mixture: GraspMixture) -> torch.Tensor:
    return torch.cat([mixture.weights, mixture.means.flatten(), mixture.covariances.flatten()])


def test_subsets_are_nested_random_and_the_same_for_any_number_of_processes():
    x = torch.arange(1000.0, dtype=torch.float64)[:, None]
    whole = Subsets.of(DataRows(x), 100, seed=3)
    assert whole.sizes == (125, 250, 500, 1000) == tuple(sorted(halves(1000)[:4]))
    found = [whole.take(size).rows[:, 0] for size in whole.sizes]
    assert [len(rows) for rows in found] == list(whole.sizes)
    for small, large in itertools.pairwise(found):
        assert bool(torch.isin(small, large).all())
    # The mean of a random subset deviates by its standard error, not with the order of the rows.
    assert abs(float(found[2].mean()) - 499.5) < 4 * 1000 / (12 * 500) ** 0.5
    assert not torch.equal(found[0], Subsets.of(DataRows(x), 100, seed=4).take(125).rows[:, 0])
    lengths = (10, 690, 300)
    parts = [Part(rows, k, 3, lengths) for k, rows in enumerate(x.split(lengths))]
    for size, rows in zip(whole.sizes, found, strict=True):
        assert torch.equal(
            torch.cat([Subsets.of(part, 100, 3).take(size).rows[:, 0] for part in parts]), rows
        )
    assert (
        Subsets.of(DataRows(x), None, 0).sizes == Subsets.of(DataRows(x), 501, 0).sizes == (1000,)
    )


def test_eq20_a_fit_by_subsets_is_a_fixed_point_of_scikit_learn_and_as_likely_as_full_batch_em():
    samples = ring(6000)
    tolerance = 1e-4
    stepwise = fit_mixture(samples, 6, tolerance=tolerance, starts=3, subset=600)
    full = fit_mixture(samples, 6, tolerance=tolerance, starts=3)
    mean = float(stepwise.log_prob(samples.rows()).mean())
    assert abs(float(stepwise.meta["log_likelihood"]) - mean) < 1e-5  # of all rows, not of a subset
    assert stepwise.meta["converged"] == "true" and stepwise.meta["fit_subset"] == "600"
    assert mean > float(full.meta["log_likelihood"]) - 0.01
    # scikit-learn takes one step of EM from the fit, in standardised columns: it gains less than
    # the tolerance.
    x = samples.rows()
    scale = x.std(0, correction=0)
    theirs = GaussianMixture(
        6,
        weights_init=stepwise.weights.numpy(),
        means_init=((stepwise.means - x.mean(0)) / scale).numpy(),
        precisions_init=torch.linalg.inv(stepwise.covariances / scale[:, None] / scale).numpy(),
        max_iter=2,
        tol=0.0,
    )
    with pytest.warns(match="did not converge"):
        theirs.fit(((x - x.mean(0)) / scale).numpy())
    gain = theirs.score(((x - x.mean(0)) / scale).numpy()) - float(scale.log().sum()) - mean
    assert -1e-5 < gain < 2 * tolerance
    np.testing.assert_allclose(
        np.sort(np.asarray(theirs.weights_)), stepwise.weights.sort().values, atol=0.01
    )


def test_the_seed_alone_decides_a_fit_and_half_of_the_rows_or_more_are_full_batch_em():
    samples = ring()
    one, same = (fit_mixture(samples, 5, 1, iterations=30, starts=2, subset=300) for _ in range(2))
    assert torch.equal(parameters(one), parameters(same)) and one.meta == same.meta
    assert not torch.equal(
        parameters(one), parameters(fit_mixture(samples, 5, 2, iterations=30, subset=300))
    )
    # One subset holds all rows.
    assert torch.equal(
        parameters(fit_mixture(samples, 5, subset=1501)), parameters(fit_mixture(samples, 5))
    )
    assert (
        int(fit_mixture(samples, 5, tolerance=0.0, iterations=12, subset=300).meta["iterations"])
        == 12
    )


@pytest.mark.promise("F2")
def test_a_fit_by_subsets_goes_on_where_it_was_killed(tmp_path):
    samples = ring()
    path = tmp_path / "fit.safetensors"
    fit = {"tolerance": 1e-3, "subset": 200, "starts": 2}
    steps: list[FitProgress] = []
    whole = fit_mixture(samples, 5, observer=steps.append, **fit)
    rows = [step.rows for step in steps]
    assert rows == sorted(rows) and rows[-1] == 3000 and len(set(rows)) > 1
    last = [k for k, (a, b) in enumerate(itertools.pairwise(rows), 1) if a != b]
    for stop in sorted(
        {1, *last, last[-1] + 1}
    ):  # in a subset, and on either side of a change of subsets
        path.unlink(missing_ok=True)
        _kill_after(stop, samples, path, fit)
        assert load_tensors(path, "em", STATE)[1]["step_rows"] == str(rows[stop - 1])
        more: list[FitProgress] = []
        again = fit_mixture(samples, 5, checkpoint=path, observer=more.append, **fit)
        assert [step.rows for step in more] == rows[stop:]
        assert torch.equal(parameters(again), parameters(whole)) and again.meta == whole.meta
    tensors, meta = load_tensors(path, "em", STATE)
    save_tensors(path, "em", tensors, meta | {"step_rows": "17"})
    with pytest.raises(ModelFileError, match="a step on '17' rows"):
        fit_mixture(samples, 5, checkpoint=path, **fit)


def _kill_after(stop: int, samples, path: Path, fit) -> None:
    """Fit with a checkpoint, and be killed after so many steps."""
    steps: list[FitProgress] = []

    def kill(progress: FitProgress) -> None:
        steps.append(progress)
        if len(steps) == stop:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_mixture(samples, 5, checkpoint=path, observer=kill, **fit)


def test_a_subset_that_cannot_hold_the_components_is_refused():
    samples = ring(200)
    for subset in (0, 8, 44):
        with pytest.raises(BadArgument, match=rf"subset: expected .*got {subset}"):
            fit_mixture(samples, 5, subset=subset)
