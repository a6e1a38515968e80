"""The model of stable grasps: Bayes' rule and the conditional against closed forms, its file, and
whose it is.
"""

import dataclasses

import numpy as np
import pytest
import torch

from torchgrasp import load_hand
from torchgrasp.control.paper.stability import (
    NAMES,
    StabilityModel,
    lengths_of,
    load_stability,
    state_of,
)
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.geometry.frames import rotation_from_vector
from torchgrasp.posture_model.gaussian import GaussianMixture
from torchgrasp.posture_model.mixture import describe_compatibility, encode_fingertips


def states(count: int, strength: float, seed: int) -> torch.Tensor:
    """States whose third finger presses as the others together, and the firmer the wider the grasp."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, 9, generator=generator, dtype=torch.float64)
    lengths = 0.04 * (0.2 * noise[:, :3]).exp()
    fingers = strength * (lengths[:, :2] / 0.04) ** 1.5 * (0.1 * noise[:, 3:5]).exp()
    forces = torch.cat([fingers, fingers.sum(1, keepdim=True) * (0.05 * noise[:, 5:6]).exp()], 1)
    return state_of(100 * (0.5 * noise[:, 6:]).exp(), lengths, forces)


def gaussian(some: torch.Tensor) -> GaussianMixture:
    """One Gaussian with the mean and the covariance of some states."""
    covariance = some.T.cov(correction=0)
    return GaussianMixture(torch.ones(1).double(), some.mean(0)[None], covariance[None], NAMES)


def learned(meta: dict[str, str]) -> StabilityModel:
    """The model of 400 firm grasps that held, and of 200 weak ones that did not."""
    return StabilityModel(gaussian(states(400, 2.0, 0)), gaussian(states(200, 0.7, 1)), 2 / 3, meta)


@pytest.fixture(scope="module")
def model() -> StabilityModel:
    hand = load_hand("allegro")
    meta = {**describe_compatibility(hand), "joint_names": ",".join(hand.joint_names)}
    return learned(meta)


def tips(width: float) -> torch.Tensor:
    return torch.tensor(
        [[width, 0.02, 0.0], [width, -0.02, 0.0], [-width, 0.0, 0.0]], dtype=torch.float64
    )


def test_lengths_are_those_of_the_code_in_any_frame():
    points = tips(0.03)
    normals = torch.eye(3).double()
    assert torch.allclose(lengths_of(points), encode_fingertips(points, normals)[:3])
    turned = points @ rotation_from_vector(torch.tensor([0.3, 0.4, -0.2]).double()).T + 0.1
    assert torch.allclose(lengths_of(turned), lengths_of(points))
    quiet = state_of(torch.ones(3), torch.ones(3), torch.tensor([-0.1, 0.0, 1.0]))
    assert quiet[6:].exp().tolist() == pytest.approx([0.05, 0.05, 1.0])


def test_log_odds_rank_held_grasps_above_others():
    """Both densities are Gaussians of known mean: the odds are their quadratic form, and rank
    held-out states.
    """
    held = states(300, 2.0, 2)
    failed = states(300, 0.7, 3)
    fitted = learned({})
    right = fitted.log_odds(held)
    wrong = fitted.log_odds(failed)
    assert float((right[:, None] > wrong).double().mean()) > 0.95
    seen = [0, 1, 2, 6, 7, 8]
    oracle = torch.zeros(300).double()
    for mixture, sign in ((fitted.stable, 1), (fitted.others, -1)):
        mean = mixture.means[0, seen]
        block = mixture.covariances[0][seen][:, seen]
        oracle += sign * torch.distributions.MultivariateNormal(mean, block).log_prob(held[:, seen])
    assert torch.allclose(right, oracle + torch.tensor(2.0).log(), atol=1e-6)


def test_preferred_forces_are_the_regression_on_the_lengths(model: StabilityModel):
    """Twice as wide, 2^1.5 as firm; the thumb presses as both fingers; the deviation is that of the
    draws.
    """
    narrow = model.preferred_forces(tips(0.03))
    wide = model.preferred_forces(tips(0.06))
    ratio = (lengths_of(tips(0.06)) / lengths_of(tips(0.03)))[:2]
    assert torch.allclose(wide.forces[:2] / narrow.forces[:2], ratio**1.5, rtol=0.15)
    assert float(narrow.forces[2]) == pytest.approx(float(narrow.forces[:2].sum()), rel=0.1)
    deviation = narrow.covariance.diagonal().sqrt() / narrow.forces
    assert deviation[:2].tolist() == pytest.approx([0.13, 0.13], abs=0.05)
    assert torch.allclose(narrow.springs, torch.full((3,), 100.0).double(), rtol=0.3)
    firmer = 1.2 * float(narrow.forces[2])
    asked = model.preferred_forces(tips(0.03), firmer)
    assert float(asked.forces[2]) == pytest.approx(firmer)
    assert float(asked.forces[:2].sum()) == pytest.approx(firmer, rel=0.15)
    assert float(asked.forces[:2].sum()) > float(narrow.forces[:2].sum())
    assert float(asked.covariance[2].abs().max()) == 0.0
    moved = model.preferred_forces(
        tips(0.03) @ rotation_from_vector(torch.tensor([0.5, 0.1, 0.9]).double()).T + 1.0
    )
    assert torch.allclose(moved.forces, narrow.forces)
    with pytest.raises(BadArgument, match="tips"):
        model.preferred_forces(tips(float("nan")))


def test_preferred_forces_and_their_covariance_in_numpy(model: StabilityModel):
    """Of one Gaussian over logarithms: its conditional on the lengths, and the covariance f_i S_ij
    f_j of forces.
    """
    mean = model.stable.means[0].double().numpy()
    cov = model.stable.covariances[0].double().numpy()
    lengths = lengths_of(tips(0.05)).log().numpy()

    def condition(
        given: list[int], values: np.ndarray, asked: list[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        gain = cov[np.ix_(asked, given)] @ np.linalg.inv(cov[np.ix_(given, given)])
        return mean[asked] + gain @ (values - mean[given]), cov[np.ix_(asked, asked)] - gain @ cov[
            np.ix_(given, asked)
        ]

    log, spread = condition([3, 4, 5], lengths, [6, 7, 8])
    free = model.preferred_forces(tips(0.05))
    forces = np.exp(log)
    np.testing.assert_allclose(free.forces.numpy(), forces, rtol=1e-6)
    np.testing.assert_allclose(
        free.covariance.numpy(), forces[:, None] * spread * forces, rtol=1e-5
    )
    stiff = condition([3, 4, 5], lengths, [0, 1, 2])[0]
    np.testing.assert_allclose(free.springs.numpy(), np.exp(stiff), rtol=1e-6)
    asked = model.preferred_forces(tips(0.05), 3.0)
    log, spread = condition(
        [3, 4, 5, 8], np.append(lengths, np.log(3.0)), [6, 7]
    )  # the third finger presses hardest
    forces = np.append(np.exp(log), 3.0)
    np.testing.assert_allclose(asked.forces.numpy(), forces, rtol=1e-6)
    spread = np.pad(spread, (0, 1))
    np.testing.assert_allclose(
        asked.covariance.numpy(), forces[:, None] * spread * forces, rtol=1e-5, atol=1e-12
    )


def test_stability_file_is_read_back_and_refused_for_another_hand_or_a_bad_fit(
    model: StabilityModel, tmp_path
):
    path = model.save(tmp_path / "stability.safetensors")
    assert path.stat().st_size < 100_000
    again = load_stability(load_hand("allegro"), path)
    assert torch.equal(again.stable.means, model.stable.means)
    assert torch.equal(again.log_odds(states(5, 1.0, 4)), model.log_odds(states(5, 1.0, 4)))
    with pytest.raises(BadArgument, match="joints"):
        load_stability(load_hand("barrett"), path)
    with pytest.raises(BadArgument, match="fingertips"):
        load_stability(load_hand("allegro_biotac"), path)
    (tmp_path / "broken.safetensors").write_bytes(path.read_bytes()[:200])
    with pytest.raises(ModelFileError):
        load_stability(load_hand("allegro"), tmp_path / "broken.safetensors")
    with pytest.raises(BadArgument, match="share"):
        dataclasses.replace(model, share=1.0)
    with pytest.raises(BadArgument, match="names"):
        dataclasses.replace(model, stable=model.stable.marginal(NAMES[:6]))


def test_load_stability_finds_the_shipped_models():
    assert load_stability(load_hand("allegro_biotac")) is None
    for name in ("allegro", "barrett"):
        hand = load_hand(name)
        shipped = load_stability(hand)
        assert shipped is not None
        assert float(shipped.meta["auc"]) > 0.75
        preferred = shipped.preferred_forces(tips(0.04))
        assert 0.5 < float(preferred.forces.min()) < float(preferred.forces.max()) < 10.0
        firm, weak = (
            shipped.log_odds(
                state_of(preferred.springs, lengths_of(tips(0.04)), factor * preferred.forces)
            )
            for factor in (1.0, 0.25)
        )
        assert float(firm) > 0 > float(weak)
