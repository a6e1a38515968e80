"""The learned posture model: a Gaussian mixture over the joints of a hand and the codes of its fingertips (Sec. 4)."""

from torchgrasp.posture_model.mixture import encode
from torchgrasp.posture_model.sample import HandSamples, SampleSpec, sample_configurations
from torchgrasp.posture_model.dataset import SampleFolder, load_samples, write_samples
from torchgrasp.posture_model.em import Components, Progress
from torchgrasp.posture_model.fit import fit_mixture
from torchgrasp.posture_model.gaussian import GaussianMixture
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, PAPER_ENERGY, GraspMixture, load_mixture

__all__ = [
    "encode", "HandSamples", "SampleSpec", "sample_configurations", "SampleFolder", "write_samples", "load_samples",
    "Components", "Progress", "fit_mixture", "GaussianMixture", "GraspMixture", "PAPER_ENERGY", "DEFAULT_ENERGY",
    "load_mixture",
]  # fmt: skip
