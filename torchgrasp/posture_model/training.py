"""Fit of the learned posture model to sampled postures (Eqs. 19-20, Sec. 6.3), with checkpoints."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.foundation.base import check_whole
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, ModelFileError
from torchgrasp.foundation.rules import Count, Fraction, Range, Seed
from torchgrasp.posture_model.em import (
    Components,
    DataRows,
    EmRule,
    Fit,
    FitProgress,
    expectation_maximisation,
    likeliest,
    start_components,
)
from torchgrasp.posture_model.mixture import CODE_NAMES, GraspMixture
from torchgrasp.posture_model.sample import HandSamples
from torchgrasp.posture_model.stepwise import Subsets, fit_smallest, fit_subsets, halves

MAX_REGULARISATION = 1e-6  # largest variance added to a dimension, relative to the data's


@dataclasses.dataclass(frozen=True)
class MixtureNumbers:
    """Parameters of the fit of a Gaussian mixture to sampled postures."""

    trial_steps: int = 20
    """Number of EM steps from each of several starts before their likelihoods are compared. A whole
    fit takes some hundred.
    """
    constant: float = 1e-9
    """Standard deviation of a dimension, over 1 + |mean|, up to which the dimension counts as
    constant.
    """
    same: float = 1e-9
    """Greatest relative difference of means and deviations of the same data, summed in another
    order.
    """
    same_zero: float = 1e-12
    """Greatest absolute difference of such means and deviations, for those near zero."""


MIXTURES = MixtureNumbers()


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The checkpoint file of one fit of a mixture, and what identifies this fit.

    Process 0 writes the file, all processes read it. `centre` and `scale` identify the data, and
    `settings` the fit.
    """

    path: Path | None  # path of the file; None means no file
    shard: DataRows  # data rows of this process
    centre: Float[Tensor, "d"]  # mean of each dimension of the data, in its unit
    scale: Float[Tensor, "d"]  # standard deviation of each dimension, in its unit
    settings: dict[str, str]  # settings of the fit, as texts by name

    def save(self, progress: FitProgress) -> None:
        """Write the state of the fit to the file, atomically; do nothing without a `path` or in a
        process other than 0.

        Raises `OutputError` if the file cannot be written.
        """
        if self.path is None or self.shard.rank > 0:
            return
        tensors = {**vars(progress.components), "centre": self.centre, "scale": self.scale}
        tensors |= {"reseeded": progress.reseeded, "log_likelihood": progress.log_likelihood}
        meta = {**self.settings, "jumped": str(progress.jumped), "step_rows": str(progress.rows)}
        save_tensors(self.path, "em", tensors, meta)

    def load(self) -> FitProgress | None:
        """Return the state of the fit that the file holds, or None if there is no file.

        Raises `ModelFileError` for a damaged file, and `BadArgument` for the file of another fit.
        `BadArgument` is also raised if some processes see the file and others do not.
        """
        progress = self._read(self.path) if self.path and self.path.exists() else None
        steps = len(progress.log_likelihood) if progress else 0
        # Processes at different steps would wait for each other for ever. Equal steps have no
        # variance.
        total, squares = self.shard.sum(
            torch.tensor([steps, steps**2], device=self.centre.device)
        ).tolist()
        if squares * self.shard.processes != total**2:
            found = "a file that some processes see and others do not"
            raise BadArgument("checkpoint", found, "a file for all of them")
        return progress

    def _read(self, path: Path) -> FitProgress:
        """Read the progress of an EM fit from a checkpoint; raise an error if it is not of this
        fit.
        """
        m = int(self.settings["components"])
        d = len(self.centre)
        shapes = {"weights": (m,), "means": (m, d), "covariances": (m, d, d), "reseeded": (m,)}
        shapes |= {"log_likelihood": (-1,), "centre": (d,), "scale": (d,)}
        tensors, meta = load_tensors(path, "em", set(shapes))
        other = {k: meta.get(k) for k, v in self.settings.items() if meta.get(k) != v}
        for name, ours in (("centre", self.centre), ("scale", self.scale)):
            saved = tensors[name].to(ours)
            if saved.shape != ours.shape or not torch.allclose(
                saved, ours, rtol=MIXTURES.same, atol=MIXTURES.same_zero
            ):
                other[name] = "of other data"
        if other:
            fit = f"the checkpoint of this fit: {self.settings} and the same data"
            raise BadArgument("checkpoint", f"{path}: {other}", f"a new file, or {fit}")
        for name, shape in shapes.items():
            t = tensors[name]
            dtype = torch.int64 if name == "reseeded" else torch.float64
            if (shape != (-1,) and t.shape != shape) or t.dtype != dtype:
                found = f"{path}: {name} {tuple(t.shape)} {t.dtype}"
                raise ModelFileError("checkpoint", found, str(shape))
        sizes = {str(size): size for size in halves(int(self.settings["rows"]))}
        step_rows = meta.get("step_rows", "")
        if step_rows not in sizes:
            found = f"{path}: a step on {step_rows!r} rows"
            raise ModelFileError("checkpoint", found, f"one of {list(sizes)}")
        progress = FitProgress(
            Components(tensors["weights"], tensors["means"], tensors["covariances"]),
            tensors["reseeded"],
            tensors["log_likelihood"],
            meta.get("jumped") == "True",
            sizes[step_rows],
        )
        return progress.to(self.centre.device)


@checked
def fit_mixture(
    samples: HandSamples,
    components: Count,
    seed: Seed = 0,
    iterations: Annotated[int, Range(1, 100000)] = 300,
    tolerance: Fraction = 1e-3,
    regularisation: Annotated[float, Range(0.0, MAX_REGULARISATION)] = MAX_REGULARISATION,
    *,
    starts: Annotated[int, Range(1, 1000)] = 1,
    subset: Count | None = None,
    checkpoint: Path | str | None = None,
    distributed: bool = False,
    observer: Callable[[FitProgress], None] = lambda progress: None,
) -> GraspMixture:
    """Return the mixture of Eqs. (19)-(20) of the paper, fitted to sampled postures by
    expectation-maximisation (EM).

    The fit starts from k-means. The mixture's `meta` reports iterations, convergence, collapsed
    components, mean log-likelihood [nats] and the Bayesian information criterion (BIC). Contact
    codes are exact functions of the joints, so the BIC keeps falling with more components. To
    choose their number, use the BIC's elbow, not its minimum.

    Args:
        samples: n postures of one hand: joints [rad or m] and contact codes of the fingertips
            (`encode`).
        components: number m of Gaussians.
        seed: seed of k-means, and of the random subsets.
        iterations: largest number of EM steps.
        tolerance: least rise [nats] of the mean log-likelihood in a step; the fit stops at a
            smaller one.
        regularisation: variance added to every dimension of a component, relative to the
            dimension's variance over all samples.
        starts: number of k-means initialisations, with consecutive seeds. After a short fit from
            each, only the fit of the greatest likelihood continues.
        subset: least number of samples in nested random subsets, each half of the next. EM fits one
            subset after the other, and all samples at last. The `starts` are compared on small
            subsets. None means that EM uses all samples in each step.
        checkpoint: file that stores the fit after every step; None means none. If it exists, the
            fit continues from it. The result is bitwise that of an uninterrupted fit.
        distributed: whether this is one of several processes under torchrun, and `samples` are only
            its part. All processes must see the same checkpoint.
        observer: function that is called with the state of the fit after each step.

    Raises:
        BadArgument: too few samples, or codes of another number of fingers than three.
        BadArgument: samples without one name for each joint.
        BadArgument: a joint that does not vary, a number out of range, or another fit's checkpoint.
        ModelFileError: a damaged checkpoint.
        OutputError: a checkpoint that cannot be written.
        IndefiniteCovariance: a component collapses more than three times, or all collapse in one
            step. It collapses if its covariance is singular, or it has too few samples.

    >>> import torch
    >>> numbers = torch.rand(500, 7, generator=torch.Generator().manual_seed(0))
    >>> samples = HandSamples(numbers[:, :1], numbers[:, 1:], ("knuckle",))
    >>> fit_mixture(samples, components=2).joint_names
    ('knuckle',)
    """
    shard, centre, scale = standardised_rows(samples, components, distributed)
    if subset is not None and subset < (least := components * (len(scale) + 2)):
        raise BadArgument("subset", subset, f"at least {least}")
    n = shard.count()
    subsets = Subsets.of(shard, subset, seed)
    settings = {
        "rows": n,
        "components": components,
        "seed": seed,
        "starts": starts,
        "regularisation": regularisation,
        "subset": subset,
    }
    path = None if checkpoint is None else Path(checkpoint)
    told = {name: str(value) for name, value in settings.items()}
    saved = Checkpoint(path, shard, centre, scale, told)
    rule = EmRule(iterations, tolerance, regularisation)

    def try_start(begun: FitProgress) -> Fit:
        if subset is not None:
            return fit_smallest(subsets, begun, rule)
        trial = EmRule(MIXTURES.trial_steps, 0.0, regularisation)
        return expectation_maximisation(shard, begun, trial)

    start = saved.load()
    if start is None:
        first = subsets.take(subsets.sizes[0])
        seeds = range(seed, seed + starts)
        begun = [start_components(first, components, k, regularisation) for k in seeds]
        start = likeliest(begun, try_start)

    def observe(progress: FitProgress) -> None:
        saved.save(progress)
        observer(progress)

    sizes = [size for size in subsets.sizes if size >= start.rows]  # the smaller ones are done
    fit = fit_subsets(subsets, sizes, start, rule, observe)
    log_likelihood = float(fit.log_likelihood[-1] - scale.log().sum())  # in the samples' units
    report = {
        "samples": str(n),
        "fit_seed": str(seed),
        "fit_starts": str(starts),
        "iterations": str(len(fit.log_likelihood) - 1),
        "converged": str(fit.converged).lower(),
        "reseeded": str(int(fit.reseeded.sum())),
        "log_likelihood": f"{log_likelihood:.6f}",
        "bic": f"{information_criterion(fit.components, n, log_likelihood):.1f}",
    }
    report |= {} if subset is None else {"fit_subset": str(subset)}
    names = (*samples.joint_names, *CODE_NAMES)
    means = fit.components.means * scale + centre
    covariances = fit.components.covariances * scale[:, None] * scale
    return GraspMixture(
        fit.components.weights, means, covariances, names, regularisation, samples.meta | report
    )


def information_criterion(components: Components, n: int, log_likelihood: float) -> float:
    """Return the Bayesian information criterion (BIC) of a mixture fitted to n samples; smaller is
    better.

    Of `components` only the number of parameters counts. `log_likelihood` [nats] is the mean over
    the samples in their own units, before they were standardised.
    """
    m, d = components.means.shape
    parameters = (m - 1) + m * d + m * d * (d + 1) // 2  # of weights, means and full covariances
    return -2 * n * log_likelihood + parameters * math.log(n)


def standardised_rows(
    samples: HandSamples, components: int, distributed: bool = False
) -> tuple[DataRows, Float[Tensor, "d"], Float[Tensor, "d"]]:
    """Return (rows, means, deviations): standardised samples, and the mean and standard deviation
    of each dimension before.

    The rows have mean 0 and variance 1 in each of the d dimensions: the joints [rad or m], then the
    contact code. `distributed` says whether `samples` are only the part of this process. Raises
    `BadArgument` for codes not of three fingertips, or for less than d + 2 samples for each of
    `components`. Raises it also for a dimension that does not vary.
    """
    if samples.q.shape[1] != len(CODE_NAMES):
        found = f"codes of {samples.q.shape[1]} numbers"
        raise BadArgument("samples", found, "codes of three fingertips: six numbers")
    if len(samples.joint_names) != samples.joints.shape[1]:
        found = f"{len(samples.joint_names)} names of {samples.joints.shape[1]} joints"
        raise BadArgument("samples", found, "one for each")
    # a copy, which is standardised in place
    shard = DataRows.of(samples.rows().double(), distributed)
    n = shard.count()
    # Fewer samples leave the covariance of d dimensions singular.
    least = shard.rows.shape[1] + 2
    if n < least:
        raise BadArgument("samples", f"{n} samples", f"at least {least}")
    check_whole("components", components, 1, n // least)
    x = shard.rows
    names = (*samples.joint_names, *CODE_NAMES)
    centre = shard.sum(x.sum(0)) / n
    x.sub_(centre)
    scale = (shard.sum(x.square().sum(0)) / n).sqrt()
    constant = (scale <= MIXTURES.constant * (1 + centre.abs())).tolist()
    if any(constant):
        found = ", ".join(name for name, c in zip(names, constant, strict=True) if c)
        allowed = "samples that vary in every dimension"
        raise BadArgument("samples", f"no variation in {found}", allowed)
    x.div_(scale)
    return shard, centre, scale
