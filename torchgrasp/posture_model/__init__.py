"""The learned posture model: a Gaussian mixture over the joints of a hand and the codes of its
fingertips (Sec. 4).
"""

from torchgrasp.posture_model.sample import HandSamples, SampleSpec
from torchgrasp.posture_model.dataset import SampleFolder, load_samples, write_samples
from torchgrasp.posture_model.em import Components, FitProgress
from torchgrasp.posture_model.gaussian import GaussianMixture
from torchgrasp.posture_model.mixture import DEFAULT_ENERGY, PAPER_ENERGY

__all__ = [
    "HandSamples",
    "SampleSpec",
    "SampleFolder",
    "write_samples",
    "load_samples",
    "Components",
    "FitProgress",
    "GaussianMixture",
    "PAPER_ENERGY",
    "DEFAULT_ENERGY",
]
