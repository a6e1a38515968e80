"""The mixture against torch.distributions, brute-force Bayes and Monte Carlo; its file against
abuse.
"""

import math

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.stats import chi2

from torchgrasp.files import save_tensors
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.posture_model.mixture import (
    CODE_NAMES,
    DEFAULT_ENERGY,
    PAPER_ENERGY,
    GraspMixture,
    load_mixture,
)

NAMES = ("a", "b", *CODE_NAMES)


def random_mixture(m: int, seed: int = 0) -> GraspMixture:
    rng = torch.Generator().manual_seed(seed)
    d = len(NAMES)
    root = torch.randn(m, d, d, generator=rng, dtype=torch.float64)
    weights = torch.rand(m, generator=rng, dtype=torch.float64) + 0.2
    means = 2 * torch.randn(m, d, generator=rng, dtype=torch.float64)
    return GraspMixture(
        weights / weights.sum(), means, root @ root.transpose(1, 2) / d + 0.1 * torch.eye(d), NAMES
    )


def gaussians(mixture: GraspMixture) -> list[torch.distributions.MultivariateNormal]:
    pairs = zip(mixture.means, mixture.covariances, strict=True)
    return [torch.distributions.MultivariateNormal(mean, covariance) for mean, covariance in pairs]


def test_eq19_log_prob_is_the_density_and_eq21_energy_half_the_least_mahalanobis_distance(
    generator,
):
    mixture = random_mixture(5)
    x = 2 * torch.randn(40, 3, 8, generator=generator, dtype=torch.float64)
    density = torch.stack([g.log_prob(x).exp() for g in gaussians(mixture)], -1) @ mixture.weights
    torch.testing.assert_close(mixture.log_prob(x), density.log(), rtol=1e-9, atol=1e-9)
    mixture = random_mixture(4)
    q = torch.randn(30, 6, 6, generator=generator, dtype=torch.float64)
    each = []
    for mean, covariance in zip(mixture.means[:, 2:], mixture.covariances[:, 2:, 2:], strict=True):
        each.append(
            0.5
            * torch.einsum("...i,ij,...j->...", q - mean, torch.linalg.inv(covariance), q - mean)
        )
    torch.testing.assert_close(mixture.energy(q), torch.stack(each).amin(0), rtol=1e-9, atol=1e-9)
    mixture = random_mixture(3)
    q = torch.randn(10, 6, generator=torch.Generator().manual_seed(2))
    assert mixture.energy(q).dtype == torch.float32
    torch.testing.assert_close(mixture.energy(q), mixture.energy(q.double()).float())


@pytest.mark.promise("N12")
@pytest.mark.parametrize("name", ["weights", "means", "covariances"])
def test_a_parameter_that_was_changed_in_place_counts_as_it_is_now(generator, name):
    """As by an average of an optimiser's steps, whose parameters require no gradient."""
    mixture = random_mixture(3)
    x = torch.randn(20, 8, generator=generator, dtype=torch.float64)
    q = x[:, 2:]
    mixture.log_prob(x)
    mixture.joints(q)
    parameter = getattr(mixture, name)
    for _ in range(2):
        parameter.copy_(parameter.flip(0))
        parameter *= {"weights": 1.0, "means": 1.3, "covariances": 0.7}[name]
        parts = torch.stack([g.log_prob(x) for g in gaussians(mixture)], -1)
        density = torch.logsumexp(parts + mixture.weights.log(), -1)
        torch.testing.assert_close(mixture.log_prob(x), density, rtol=1e-9, atol=1e-9)
        now = random_mixture(3)
        getattr(now, name).copy_(parameter)
        for found, wanted in (
            (mixture.energy(q), now.energy(q)),
            (mixture.joints(q), now.joints(q)),
            (mixture.modes(q, 2)[0], now.modes(q, 2)[0]),
        ):
            torch.testing.assert_close(found, wanted, rtol=0, atol=0)


def test_eq21_thresholds_accept_what_their_names_say():
    assert math.isclose(2 * DEFAULT_ENERGY, chi2.ppf(0.95, 6), abs_tol=1e-7)
    n = 1_000_000
    mixture = random_mixture(1)
    factor = torch.linalg.cholesky(mixture.covariances[0, 2:, 2:])
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=(n, 6)))
    energy = mixture.energy(mixture.means[0, 2:] + noise @ factor.T)
    for threshold, probability in ((PAPER_ENERGY, chi2.cdf(4.0, 6)), (DEFAULT_ENERGY, 0.95)):
        accepted = float((energy < threshold).double().mean())
        assert abs(accepted - probability) < 3 * math.sqrt(probability * (1 - probability) / n)
    assert abs(chi2.cdf(2 * PAPER_ENERGY, 6) - 0.323) < 5e-4


@pytest.mark.promise("N11")
def test_eq23_conditional_mean_is_brute_force_bayes():
    # Two joints: sum the joint density over a fine grid of both, a Riemann sum that is exact for
    # Gaussians.
    mixture = random_mixture(3)
    q = mixture.means[:2, 2:] + 0.1
    axis = torch.linspace(-12, 12, 401, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis)
    for one, result in zip(q, mixture.joints(q), strict=True):
        log_density = mixture.log_prob(torch.cat([grid, one.expand(len(grid), 6)], -1))
        weight = torch.softmax(log_density, 0)
        torch.testing.assert_close(result, weight @ grid, rtol=1e-9, atol=1e-9)


def test_eq23_modes_recover_the_mean_in_order_and_codes_far_away_or_nan_spoil_no_other(generator):
    mixture = random_mixture(5)
    q = torch.randn(7, 2, 6, generator=generator, dtype=torch.float64)
    joints, weights = mixture.modes(q, 5)
    assert joints.shape == (7, 2, 5, 2)
    torch.testing.assert_close(weights.sum(-1), torch.ones(7, 2, dtype=torch.float64))
    torch.testing.assert_close((weights[..., None] * joints).sum(-2), mixture.joints(q))
    assert bool((weights.diff(dim=-1) <= 0).all())
    torch.testing.assert_close(mixture.modes(q, 2)[0], joints[..., :2, :])
    with pytest.raises(BadArgument, match=r"k: expected .*got 6"):
        mixture.modes(q, 6)
    mixture = random_mixture(3)
    joints, weights = mixture.modes(torch.full((1, 6), 1e4, dtype=torch.float64), 1)
    assert bool(joints.isfinite().all())
    torch.testing.assert_close(weights, torch.ones_like(weights))
    q = torch.zeros(2, 6, dtype=torch.float64)
    q[0] = float("nan")
    assert mixture.energy(q).isnan().tolist() == [True, False]
    assert mixture.joints(q).isnan().any(-1).tolist() == [True, False]
    assert mixture.energy(torch.zeros(0, 6, 6)).shape == (0, 6)
    assert mixture.joints(torch.zeros(0, 6)).shape == (0, 2)


def test_save_and_load_give_the_same_mixture_and_other_files_are_refused(tmp_path):
    mixture = random_mixture(3)
    path = mixture.save(tmp_path / "hand.safetensors")
    again = load_mixture(path)
    for name in ("weights", "means", "covariances"):
        assert torch.equal(getattr(mixture, name), getattr(again, name))
    assert (again.names, again.regularisation, again.meta) == (
        mixture.names,
        mixture.regularisation,
        mixture.meta,
    )
    assert again.joint_names == ("a", "b")
    save_file(tensors_of(random_mixture(2)), tmp_path / "plain.safetensors")
    (tmp_path / "text.safetensors").write_text("no tensors")
    for name in ("plain", "text", "missing"):
        with pytest.raises(ModelFileError):
            load_mixture(tmp_path / f"{name}.safetensors")
    good = random_mixture(2)
    with pytest.raises(BadArgument, match="weights"):
        GraspMixture(good.weights * 0.9, good.means, good.covariances, NAMES)
    with pytest.raises(BadArgument, match="names"):
        GraspMixture(good.weights, good.means, good.covariances, tuple("abcdefgh"))
    with pytest.raises(BadArgument, match=r"x: expected .*got shape"):
        good.log_prob(torch.zeros(3, 5))


def tensors_of(mixture: GraspMixture) -> dict[str, torch.Tensor]:
    return {name: getattr(mixture, name).clone() for name in ("weights", "means", "covariances")}


@pytest.mark.promise("H4")
@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("weights", lambda t: t * 1.01),
        ("weights", lambda t: t * torch.tensor([-1.0, 1, 1])),
        ("weights", lambda t: t[:2]),
        ("means", lambda t: t[:, :7]),
        ("means", lambda t: t * float("inf")),
        ("means", lambda t: t.float()),
        ("means", lambda t: t[0]),
        ("covariances", lambda t: -t),
        ("covariances", lambda t: t + torch.triu(torch.ones(8, 8), 1)),
        ("covariances", lambda t: t * torch.tensor([1.0, 1, 0])[:, None, None]),
    ],
)
def test_malformed_mixtures_are_refused(tmp_path, name, spoil):
    tensors = tensors_of(random_mixture(3))
    tensors[name] = spoil(tensors[name])
    meta = {"names": " ".join(NAMES), "regularisation": "0.0"}
    path = save_tensors(tmp_path / "hand.safetensors", "mixture", tensors, meta)
    with pytest.raises(ModelFileError, match=r"path: expected .*got"):
        load_mixture(path)


@pytest.mark.parametrize(
    "meta", [{}, {"names": "a b", "regularisation": "0"}, {"names": " ".join(NAMES)}]
)
def test_missing_metadata_is_refused(tmp_path, meta):
    path = save_tensors(
        tmp_path / "hand.safetensors", "mixture", tensors_of(random_mixture(3)), meta
    )
    with pytest.raises(ModelFileError):
        load_mixture(path)
