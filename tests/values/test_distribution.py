"""Distributions of uncertain numbers, against scipy.stats, numpy and random draws."""

import numpy as np
import pytest
import torch
from scipy import stats

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.values.distribution import Distribution

# each with scipy's distributions of its parts, and their weights
MIXED = (
    (Distribution.between(0.3, 0.8), [stats.uniform(0.3, 0.5)], [1.0]),
    (
        Distribution(((0.3, 0.8), (0.6, 1.4)), (1.0, 3.0)),
        [stats.uniform(0.3, 0.5), stats.uniform(0.6, 0.8)],
        [0.25, 0.75],
    ),
    (
        Distribution.parse("0.2:0.4|1.0|0.6:0.7@2"),
        [stats.uniform(0.2, 0.2), stats.uniform(1.0, 1e-12), stats.uniform(0.6, 0.1)],
        [0.25, 0.25, 0.5],
    ),
)
LATTICE = torch.linspace(0.0, 1.501, 173, dtype=torch.float64)


@pytest.mark.parametrize(("found", "parts", "weights"), MIXED)
def test_mixtures_of_intervals_are_those_of_scipy(found, parts, weights):
    pairs = list(zip(parts, weights, strict=True))
    wanted = sum(w * part.cdf(LATTICE.numpy()) for part, w in pairs)
    np.testing.assert_allclose(found.cdf(LATTICE), wanted, atol=1e-12)
    assert found.mean == pytest.approx(sum(w * part.mean() for part, w in pairs))
    # F(x - e) < q <= F(x): the least number that q reaches
    q = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)[1:]
    x = found.quantile(q)
    upto = sum(w * part.cdf(x.numpy() + 1e-9) for part, w in pairs)
    below = sum(w * part.cdf(x.numpy() - 1e-9) for part, w in pairs)
    assert (upto >= q.numpy() - 1e-12).all()
    assert (below < q.numpy()).all()
    assert found.share(0.35, 0.65) == pytest.approx(
        sum(w * (part.cdf(0.65) - part.cdf(0.35)) for part, w in pairs)
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("found", "parts", "weights"), MIXED)
def test_the_ends_of_a_distribution_are_its_quantiles_0_and_1(found, parts, weights, dtype):
    ends = found.quantile(torch.tensor([0.0, 1.0], dtype=dtype))
    wanted = min(part.ppf(0.0) for part in parts), max(part.ppf(1.0) for part in parts)
    np.testing.assert_allclose(ends, wanted, atol=1e-6)


@pytest.mark.parametrize(("low", "high"), [(0.35, 0.65), (0.65, np.inf), (-np.inf, 1.0)])
@pytest.mark.parametrize(("found", "parts", "weights"), MIXED)
def test_what_is_left_of_a_distribution_is_that_of_its_draws(found, parts, weights, low, high):
    drawn = found.sample(10_000, 1).numpy()
    pairs = zip(parts, weights, strict=True)
    square = sum(w * (part.var() + part.mean() ** 2) for part, w in pairs)
    assert found.std == pytest.approx((square - found.mean**2) ** 0.5)
    kept = drawn[(drawn >= low) & (drawn <= high)]
    if not len(kept):
        with pytest.raises(BadArgument, match="low"):
            found.given(low, high)
        return
    wanted = (kept <= LATTICE.numpy()[:, None]).mean(-1)
    np.testing.assert_allclose(found.given(low, high).cdf(LATTICE), wanted, atol=0.03)


def test_samples_have_the_quantiles_of_numpy():
    samples = np.random.default_rng(0).lognormal(-1.0, 0.4, 307)
    found = Distribution.of_samples(torch.from_numpy(samples))
    q = np.linspace(0.0, 1.0, 57)
    wanted = np.quantile(samples, q, method="inverted_cdf")
    np.testing.assert_array_equal(found.quantile(torch.from_numpy(q)), wanted)
    ecdf = stats.ecdf(samples).cdf.evaluate(LATTICE.numpy())
    np.testing.assert_allclose(found.cdf(LATTICE), ecdf, atol=1e-12)
    assert found.mean == pytest.approx(samples.mean())


@pytest.mark.parametrize("found", [found for found, _, _ in MIXED])
def test_draws_follow_the_distribution_and_their_seed(found):
    drawn = found.sample(4000, 3)
    assert torch.equal(drawn, found.sample(4000, 3))
    assert not torch.equal(drawn, found.sample(4000, 4))
    share = (drawn[:, None] <= LATTICE).double().mean(0)
    # beyond this, a true sample of 4000 lies once in 10^5 (Dvoretzky-Kiefer-Wolfowitz)
    assert float((share - found.cdf(LATTICE)).abs().max()) < 0.04
    assert found.least <= float(drawn.min()) <= float(drawn.max()) <= found.most


@pytest.mark.parametrize("found", [found for found, _, _ in MIXED])
def test_nodes_give_means(found):
    numbers, weights = found.nodes(9)
    assert len(numbers) == len(weights) <= 9
    assert float(weights.sum()) == pytest.approx(1.0)
    assert float(weights @ numbers) == pytest.approx(found.mean)  # exact for straight lines
    drawn = found.sample(10_000, 0)
    assert float(weights @ numbers**2) == pytest.approx(float((drawn**2).mean()), rel=0.03)


def test_nodes_are_exact_for_numbers_and_few_for_many_samples():
    numbers, weights = Distribution.parse("0.18|1.0@3").nodes(9)
    assert (numbers.tolist(), weights.tolist()) == ([0.18, 1.0], [0.25, 0.75])
    samples = torch.rand(500, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    numbers, weights = Distribution.of_samples(samples).nodes(9)
    assert len(numbers) == 9
    assert float(weights @ numbers) == pytest.approx(float(samples.mean()), abs=0.02)


def test_a_number_is_certain():
    one = Distribution.of(0.7)
    assert Distribution.of(one) is one
    assert one.mean == one.least == one.most == 0.7
    assert one.cdf(torch.tensor([0.69, 0.7, float("inf")])).tolist() == [0.0, 1.0, 1.0]
    assert one.sample(3, 0).tolist() == [0.7] * 3
    assert [x.tolist() for x in one.nodes(9)] == [[0.7], [1.0]]
    assert one.cdf(torch.tensor([float("nan")])).isnan().all()


def test_the_derivative_of_the_cdf_is_the_density():
    found = MIXED[1][0]
    x = torch.tensor([0.35, 0.7, 1.1, 1.45], dtype=torch.float64, requires_grad=True)
    found.cdf(x).sum().backward()
    wanted = 0.25 * stats.uniform(0.3, 0.5).pdf(x.detach()) + 0.75 * stats.uniform(0.6, 0.8).pdf(
        x.detach()
    )
    np.testing.assert_allclose(x.grad, wanted)
    assert torch.autograd.gradcheck(found.cdf, x)
    assert torch.autograd.gradcheck(
        found.quantile, torch.tensor([0.2, 0.6]).double().requires_grad_()
    )


@pytest.mark.parametrize("text", ["0.5", ".3:.8", ".3:.8|1", "0.18@1|1.0@3", "1e-3:0.25@0.1|2@0.9"])
def test_text_is_read_back(text):
    found = Distribution.parse(text)
    assert Distribution.parse(str(found)) == found
    assert hash(Distribution.parse(str(found))) == hash(found)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Distribution.parse("0.3-0.8"), "a number, an interval such as 0.3:0.8"),
        (lambda: Distribution.parse(""), "a number, an interval"),
        (lambda: Distribution.parse("0.3:0.8:0.9"), "a number, an interval"),
        (lambda: Distribution.parse("0.3|nan"), "a finite number"),
        (lambda: Distribution.parse("0.3@-1"), "a positive number"),
        (lambda: Distribution.between(0.8, 0.3), "the lesser number first"),
        (lambda: Distribution(()), "1 to 10000 parts"),
        (lambda: Distribution(((0.0, 1.0),), (1.0, 2.0)), "1, one a part"),
        (lambda: Distribution.of(1.0).clamped(3.0, 2.0), "at most high, got 3 beside high 2"),
        (lambda: Distribution.of(1.0).quantile(torch.tensor(1.1)), r"in \[0, 1\]"),
    ],
)
def test_a_wrong_distribution_is_refused_in_one_sentence(make, said):
    with pytest.raises(BadArgument, match=said) as caught:
        make()
    assert str(caught.value).count("\n") == 0
