"""A fit that was killed goes on at its last step, to the same bits; several processes fit what one
does.
"""

import dataclasses
from pathlib import Path

import pytest
import torch

from tests.apart import run_apart
from tests.make import ring_samples as ring
from torchgrasp import GraspMixture, load_mixture
from torchgrasp.files import load_tensors
from torchgrasp.foundation.errors import BadArgument, ModelFileError, OutputError
from torchgrasp.posture_model.em import DataRows, FitProgress
from torchgrasp.posture_model.sample import HandSamples
from torchgrasp.posture_model.training import Checkpoint, fit_mixture


def parameters(mixture: GraspMixture) -> torch.Tensor:
    return torch.cat([mixture.weights, mixture.means.flatten(), mixture.covariances.flatten()])


class Killed(Exception):
    """What ends a fit in the middle."""


def fit_until(step: int, path: Path, samples: HandSamples) -> None:
    """Fit with a checkpoint and be killed after so many steps of this run."""
    steps: list[FitProgress] = []

    def kill(progress: FitProgress) -> None:
        steps.append(progress)
        if len(steps) == step:
            raise Killed

    with pytest.raises(Killed):
        fit_mixture(samples, 5, iterations=20, tolerance=0.0, checkpoint=path, observer=kill)


@pytest.mark.promise("F2")
def test_a_fit_goes_on_where_it_was_killed(tmp_path):
    samples = ring()
    path = tmp_path / "fit.safetensors"
    whole = fit_mixture(samples, 5, iterations=20, tolerance=0.0)
    for step in (1, 3, 8):  # killed three times
        fit_until(step, path, samples)
    steps: list[FitProgress] = []
    again = fit_mixture(
        samples, 5, iterations=20, tolerance=0.0, checkpoint=path, observer=steps.append
    )
    assert len(steps) == 20 - (1 + 3 + 8)
    assert torch.equal(parameters(again), parameters(whole))
    assert again.meta == whole.meta
    # Asked once more, the finished fit takes no step; with more iterations it takes those.
    assert torch.equal(
        parameters(fit_mixture(samples, 5, iterations=20, tolerance=0.0, checkpoint=path)),
        parameters(whole),
    )
    longer = fit_mixture(samples, 5, iterations=25, tolerance=0.0, checkpoint=path)
    assert torch.equal(
        parameters(longer), parameters(fit_mixture(samples, 5, iterations=25, tolerance=0.0))
    )


def test_the_checkpoint_of_another_fit_a_damaged_one_and_bad_folders_are_refused(tmp_path):
    samples = ring()
    path = tmp_path / "fit.safetensors"
    fit_mixture(samples, 5, iterations=2, checkpoint=path)
    moved = dataclasses.replace(samples, joints=samples.joints * (1 + 1e-6))
    for other, given in [
        (samples, {"components": 4}),
        (samples, {"components": 5, "seed": 1}),
        (samples, {"components": 5, "starts": 2}),
        (samples, {"components": 5, "regularisation": 1e-7}),
        (samples, {"components": 5, "subset": 500}),
        (samples[:-1], {"components": 5}),
        (moved, {"components": 5}),
    ]:
        with pytest.raises(BadArgument, match=r"checkpoint: expected .*got"):
            fit_mixture(other, **given, iterations=2, checkpoint=path)
    mixture = fit_mixture(samples, 5, iterations=2, checkpoint=path)
    data = path.read_bytes()
    for damaged in (
        b"",
        data[: len(data) // 2],
        mixture.save(tmp_path / "mixture.safetensors").read_bytes(),
    ):
        path.write_bytes(damaged)
        with pytest.raises(ModelFileError):
            fit_mixture(samples, 5, checkpoint=path)
    with pytest.raises(OutputError):
        fit_mixture(samples, 5, iterations=2, checkpoint=tmp_path / "mixture.safetensors" / "below")


SHARE = """
import torch
from torchgrasp.posture_model.sample import HandSamples
from torchgrasp.posture_model.training import fit_mixture
torch.distributed.init_process_group(
    "gloo", init_method="file://" + {folder!r} + "/meet", rank={rank}, world_size=2
)
samples = HandSamples(*torch.load({folder!r} + "/ring.pt"), ("turn",))
share = samples[:1100] if {rank} == 0 else samples[1100:]  # unequal shares
mixture = fit_mixture(
    share, 5, 3, 25, tolerance=0.0, distributed=True, checkpoint={folder!r} + "/fit"
)
mixture.save({folder!r} + "/{rank}.safetensors")
parts = fit_mixture(share, 5, 3, 60, distributed=True, subset=400, starts=2)
parts.save({folder!r} + "/parts{rank}.safetensors")
torch.distributed.destroy_process_group()
"""


def test_two_processes_fit_what_one_does(tmp_path):
    torch.save((ring().joints, ring().q), tmp_path / "ring.pt")
    run_apart(*(SHARE.format(folder=str(tmp_path), rank=rank) for rank in (0, 1)))
    first, second = (load_mixture(tmp_path / f"{rank}.safetensors") for rank in (0, 1))
    assert torch.equal(parameters(first), parameters(second))
    one = fit_mixture(ring(), 5, seed=3, iterations=25, tolerance=0.0)
    torch.testing.assert_close(parameters(first), parameters(one), rtol=1e-9, atol=1e-12)
    assert first.meta == one.meta
    parts = load_mixture(tmp_path / "parts1.safetensors")
    one = fit_mixture(ring(), 5, 3, 60, subset=400, starts=2)
    torch.testing.assert_close(parameters(parts), parameters(one), rtol=1e-7, atol=1e-10)
    # One process goes on where two stood.
    longer = fit_mixture(
        ring(), 5, seed=3, iterations=30, tolerance=0.0, checkpoint=tmp_path / "fit"
    )
    assert longer.meta["iterations"] == "30"


class OtherProcesses(DataRows):
    """A shard beside two others, whose checkpoints stand at 1 and at 3 steps."""

    def sum(self, x):
        return x + torch.tensor([1 + 3, 1 + 9])


def test_processes_whose_checkpoints_differ_are_all_refused_and_no_group_is_named(tmp_path):
    path = tmp_path / "fit.safetensors"
    mixture = fit_mixture(ring(), 5, iterations=2, checkpoint=path)
    shapes = {"weights", "means", "covariances", "reseeded", "log_likelihood", "centre", "scale"}
    tensors, meta = load_tensors(path, "em", shapes)
    settings = {
        name: meta[name] for name in ("rows", "components", "seed", "starts", "regularisation")
    }
    alone = Checkpoint(path, DataRows(ring().rows()), tensors["centre"], tensors["scale"], settings)
    progress = alone.load()
    assert progress is not None and len(progress.log_likelihood) == 2 == int(
        mixture.meta["iterations"]
    )
    with pytest.raises(
        BadArgument, match="some processes see"
    ):  # although 2 steps are the mean of 1, 2 and 3
        dataclasses.replace(alone, shard=OtherProcesses(ring().rows(), 1, 3)).load()
    with pytest.raises(
        BadArgument, match=r"distributed: expected .*got True in a process without a group"
    ):
        fit_mixture(ring(), 5, distributed=True)
