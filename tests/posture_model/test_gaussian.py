"""Marginals, conditionals, samples and density of a mixture against SciPy, scikit-learn and Bayes'
rule.
"""

import inspect
import itertools
import math

import numpy as np
import pytest
import scipy.stats
import torch
from sklearn.mixture import GaussianMixture as Peer

from torchgrasp.foundation.errors import BadArgument
from torchgrasp.posture_model.gaussian import GaussianMixture

NAMES = ("a", "b", "c", "d")


def random_mixture(m: int = 3, seed: int = 0) -> GaussianMixture:
    rng = torch.Generator().manual_seed(seed)
    root = torch.randn(m, 4, 4, generator=rng, dtype=torch.float64)
    weights = torch.rand(m, generator=rng, dtype=torch.float64) + 0.2
    means = torch.randn(m, 4, generator=rng, dtype=torch.float64)
    return GaussianMixture(
        weights / weights.sum(), means, root @ root.transpose(1, 2) + 0.2 * torch.eye(4), NAMES
    )


def as_peer(mixture: GaussianMixture) -> Peer:
    """The same mixture in scikit-learn."""
    peer = Peer(len(mixture.weights))
    peer.weights_, peer.means_, peer.covariances_ = (
        x.numpy() for x in (mixture.weights, mixture.means, mixture.covariances)
    )
    peer.precisions_cholesky_ = np.linalg.cholesky(np.linalg.inv(peer.covariances_))
    return peer


def test_eq19_log_prob_equals_scikit_learn_and_scipy(generator):
    mixture = random_mixture()
    x = 2 * torch.randn(50, 4, generator=generator, dtype=torch.float64)
    result = mixture.log_prob(x).numpy()
    np.testing.assert_allclose(
        result, as_peer(mixture).score_samples(x.numpy()), rtol=1e-9, atol=1e-9
    )
    parts = [
        float(w) * scipy.stats.multivariate_normal(mean.numpy(), covariance.numpy()).pdf(x.numpy())
        for w, mean, covariance in zip(
            mixture.weights, mixture.means, mixture.covariances, strict=True
        )
    ]
    np.testing.assert_allclose(result, np.log(sum(parts)), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("names", [s for k in (1, 2, 3) for s in itertools.permutations(NAMES, k)])
def test_eq22_every_marginal_is_the_density_of_a_part_and_eq23_every_conditional_joint_over_marginal(
    names, generator
):
    mixture = random_mixture()
    index = [NAMES.index(name) for name in names]
    x = torch.randn(5, len(names), generator=generator, dtype=torch.float64)
    density = sum(
        float(w)
        * scipy.stats.multivariate_normal(mean[index].numpy(), s[index][:, index].numpy()).pdf(
            x.numpy()
        )
        for w, mean, s in zip(mixture.weights, mixture.means, mixture.covariances, strict=True)
    )
    np.testing.assert_allclose(mixture.marginal(names).log_prob(x).exp(), density, rtol=1e-9)
    values = x[0]
    rest = [k for k in range(4) if k not in index]
    result = mixture.condition(dict(zip(names, values.tolist(), strict=True)))
    assert result.names == tuple(NAMES[k] for k in rest)
    whole = torch.randn(6, 4, generator=generator, dtype=torch.float64)
    whole[:, index] = values
    bayes = mixture.log_prob(whole) - mixture.marginal(names).log_prob(values)
    torch.testing.assert_close(result.log_prob(whole[:, rest]), bayes, rtol=1e-9, atol=1e-9)


def test_conditions_one_after_the_other_are_both_at_once_and_far_ones_leave_some_components():
    mixture = random_mixture()
    both = mixture.condition({"a": 0.3, "d": -1.0})
    after = mixture.condition({"d": -1.0}).condition({"a": 0.3})
    for name in ("weights", "means", "covariances"):
        torch.testing.assert_close(getattr(both, name), getattr(after, name))
    assert mixture.condition({}).names == NAMES
    mixture = random_mixture(seed=5)
    result = mixture.condition({"b": 1e3})
    assert 1 <= len(result.weights) <= 3
    assert bool(result.means.isfinite().all())
    assert math.isclose(float(result.weights.sum()), 1.0, rel_tol=1e-12)


def test_samples_have_the_density_of_the_mixture_and_touch_no_global_generator():
    mixture = random_mixture()
    n = 200_000
    x = mixture.sample(n, seed=1)
    assert torch.equal(x, mixture.sample(n, seed=1))
    assert not torch.equal(x[:10], mixture.sample(10, seed=2))
    mean = mixture.mean()
    second = (
        torch.einsum("m,mij->ij", mixture.weights, mixture.covariances)
        + torch.einsum("m,mi,mj->ij", mixture.weights, mixture.means, mixture.means)
        - mean[:, None] * mean
    )
    deviation = second.diagonal().sqrt()
    assert bool(((x.mean(0) - mean).abs() < 4 * deviation / math.sqrt(n)).all())
    torch.testing.assert_close(torch.cov(x.T), second, rtol=0.02, atol=0.02)
    # every dimension follows its own marginal
    for k, name in enumerate(NAMES):
        one = mixture.marginal((name,))

        def below(v, one=one):
            parts = zip(
                one.weights.tolist(),
                one.means[:, 0].tolist(),
                one.covariances[:, 0, 0].tolist(),
                strict=True,
            )
            return sum(w * scipy.stats.norm.cdf(v, mu, math.sqrt(s)) for w, mu, s in parts)

        assert scipy.stats.kstest(x[:20_000, k].numpy(), below).pvalue > 1e-4
    assert mixture.sample(0).shape == (0, 4)
    state = torch.random.get_rng_state()
    random_mixture().sample(10)
    assert torch.equal(state, torch.random.get_rng_state())


def test_bad_arguments():
    mixture = random_mixture()
    for call, match in [
        (lambda: mixture.marginal(("a", "z")), "names: expected .*got \\['z'\\]"),
        (lambda: mixture.marginal(("a", "a")), "names: expected"),
        (lambda: mixture.marginal(()), "names: expected"),
        (lambda: mixture.condition({"z": 1.0}), "names: expected"),
        (lambda: mixture.condition({"a": float("nan")}), "given.*: expected .*got nan"),
        (
            lambda: mixture.condition(dict.fromkeys(NAMES, 0.0)),
            "given: expected .*got every dimension",
        ),
        (lambda: mixture.sample(-1), "n: expected .*got -1"),
        (lambda: mixture.log_prob(torch.zeros(3, 3)), "x: expected .*got shape"),
    ]:
        with pytest.raises(BadArgument, match=match):
            call()


def test_the_docstring_of_a_property_can_be_read_of_the_class():
    assert "whitened form" in (inspect.getdoc(GaussianMixture.whitening) or "")
