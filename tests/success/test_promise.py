"""A promise: bounds keep it on fresh families in the mean, need enough families, and rise with the
share.
"""

import functools
import math

import numpy as np
import pytest
import torch

from tests.make import real
from torchgrasp.success import promise
from torchgrasp.success.promise import describe_promise, find_promise, least_log_odds


def draw_trials(families, seed, bias=0.0, size=4):
    """Log-odds of trials and whether they held, a row for each family, which is easier or harder
    than predicted.
    """
    draw = np.random.default_rng(seed)
    said = draw.normal(2.0, 1.5, size=(families, size))
    true = said + bias + draw.normal(size=(families, 1))
    return said, draw.random((families, size)) < 1 / (1 + np.exp(-true))


def draw_blindly(families, seed, rate=0.88):
    """The same of a model that knows nothing: its log-odds say nothing about success."""
    draw = np.random.default_rng(seed)
    return draw.normal(2.0, 1.5, size=(families, 4)), draw.random((families, 4)) < rate


def least(said, held, share):
    """The bound of the trials of families, each a row."""
    family = torch.arange(len(said)).repeat_interleave(said.shape[1])
    return least_log_odds(
        torch.from_numpy(said).flatten(), torch.from_numpy(held).flatten(), family, share
    )


def mean_loss(said, held, bound, share):
    """What a bound costs on families: the mean of the returned that failed, less those that may."""
    returned = np.zeros_like(held) if bound is None else said >= bound
    return float(np.mean(returned * ((~held) - (1 - share))))


@pytest.mark.parametrize(
    "draw", [draw_trials, functools.partial(draw_trials, bias=-1.0)], ids=["true", "boasts"]
)
@pytest.mark.parametrize("share", [0.8, 0.9])
def test_bounds_keep_their_promise_on_fresh_families_in_the_mean_even_if_all_predictions_are_too_high(
    draw, share
):
    said, held = draw(20_000, 999)
    bounds = [least(*draw(150, seed), share) for seed in range(100)]
    assert np.mean([mean_loss(said, held, bound, share) for bound in bounds]) <= 0.0
    found = [held[said >= bound].mean() for bound in bounds if bound is not None]
    assert len(found) > 50 and np.mean(found) >= share
    assert np.quantile(found, 0.1) > share - 0.02  # an unlucky draw of families breaks it by little


def test_a_model_that_knows_nothing_promises_what_all_grasps_do_and_seldom_more():
    said, held = draw_blindly(20_000, 999)
    fair = [least(*draw_blindly(150, seed), 0.8) for seed in range(50)]
    assert np.mean([(said >= bound).mean() for bound in fair]) > 0.95
    vain = [least(*draw_blindly(150, seed), 0.92) for seed in range(50)]
    assert sum(bound is not None for bound in vain) <= 5
    assert np.mean([mean_loss(said, held, bound, 0.92) for bound in vain]) < 0.005


def test_a_bound_is_the_least_of_two_hundred_at_which_the_families_outweigh_one_that_fails():
    said, held = draw_trials(40, 2)
    found = least(said, held, 0.8)
    bounds = np.linspace(said.min(), said.max(), 200)
    excess = [np.mean((said >= bound) * ((~held) - 0.2), 1).sum() + 0.8 for bound in bounds]
    first = np.flatnonzero(np.array(excess) < 1e-9)[0]
    assert found == pytest.approx(bounds[first])
    assert first > 0


@pytest.mark.parametrize("share", [0.5, 0.8, 0.9, 0.95])
def test_so_many_families_are_needed_that_one_more_which_fails_would_not_break_the_promise(share):
    needed = math.ceil(share / (1 - share) - 1e-9)
    said = np.full((needed + 1, 3), 2.0)
    held = np.ones((needed + 1, 3), dtype=bool)
    assert least(said, held, share) is not None and least(said[2:], held[2:], share) is None
    assert (
        least(said[2:].repeat(50, 1), held[2:].repeat(50, 1), share) is None
    )  # more trials are no more families
    assert least(said, ~held, share) is None


def test_no_trials_support_no_promise():
    none = torch.zeros(0, dtype=torch.float64)
    assert least_log_odds(none, none > 0, none.long(), 0.9) is None


def test_a_greater_share_never_has_a_lower_bound():
    for seed in range(10):
        said, held = draw_trials(100, seed)
        bounds = [least(said, held, share) for share in np.linspace(0.5, 0.99, 12)]
        numbers = [np.inf if bound is None else bound for bound in bounds]
        assert numbers == sorted(numbers) and numbers[0] < numbers[-1]


def test_numbers_and_order_of_families_do_not_matter():
    said, held = draw_trials(150, 3)
    found = least(said, held, 0.85)
    order = np.random.default_rng(0).permutation(150)
    assert least(said[order], held[order], 0.85) == pytest.approx(found)
    family = 7 * torch.arange(150).repeat_interleave(4) + 3  # numbers with gaps
    again = least_log_odds(
        torch.from_numpy(said).flatten(), torch.from_numpy(held).flatten(), family, 0.85
    )
    assert again == pytest.approx(found)


@pytest.fixture
def kept(monkeypatch):
    """Make the shipped model's trials those of some families that hold well."""

    def use(families):
        said, held = draw_trials(300, 5)
        rows = np.stack([said.ravel(), held.ravel(), np.arange(300).repeat(4)], -1)
        table = real(rows[: 4 * families].tolist()).view(-1, 3)
        monkeypatch.setattr(
            promise, "load_success_model", lambda: type("Model", (), {"kept": table})
        )
        monkeypatch.setattr(promise, "find_promise", functools.cache(find_promise.__wrapped__))
        return promise.find_promise

    return use


def test_a_promise_names_the_trials_and_families_that_chose_it(kept):
    found = kept(300)(0.8)
    assert (found.trials, found.families) == (1200, 300)
    assert found.least == least(*draw_trials(300, 5), 0.8)
    assert describe_promise(0.8).startswith("0.8 by 1200 trials of 300 families")


def test_a_promise_that_no_trials_support_says_so(kept):
    assert kept(4)(0.9) is None and "no trials" in describe_promise(0.9)
    assert kept(0)(0.9) is None
