"""The state of a fit in a file, written after every step: a fit that was killed continues from its last step."""

import dataclasses
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument, ModelFileError
from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.posture_model.em import Components, Progress, Shard


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The file of one fit; without a path nothing is kept. Process 0 writes it, all processes read it.

    Mean and standard deviation identify the data, `settings` the fit.
    """

    path: Path | None
    shard: Shard
    centre: Float[Tensor, "d"]
    scale: Float[Tensor, "d"]
    settings: dict[str, str]

    def save(self, progress: Progress) -> None:
        """Write the state atomically; raises `OutputError`."""
        if self.path is None or self.shard.rank > 0:
            return
        tensors = {**vars(progress.components), "centre": self.centre, "scale": self.scale}
        tensors |= {"reseeded": progress.reseeded, "log_likelihood": progress.log_likelihood}
        save_tensors(self.path, "em", tensors, {**self.settings, "jumped": str(progress.jumped)})

    def load(self) -> Progress | None:
        """Return the saved state, or None; raises `ModelFileError` or, for another fit's state, `BadArgument`."""
        progress = self._read(self.path) if self.path and self.path.exists() else None
        steps = len(progress.log_likelihood) if progress else 0
        # Processes at different steps would wait for each other for ever. Equal steps have no variance.
        total, squares = self.shard.sum(torch.tensor([steps, steps**2], device=self.centre.device)).tolist()
        if squares * self.shard.processes != total**2:
            found = "a file that some processes see and others do not"
            raise BadArgument("checkpoint", found, "a file for all of them")
        return progress

    def _read(self, path: Path) -> Progress:
        """Read the file and check that it belongs to this fit."""
        m, d = int(self.settings["components"]), len(self.centre)
        shapes = {"weights": (m,), "means": (m, d), "covariances": (m, d, d), "reseeded": (m,)}
        shapes |= {"log_likelihood": (-1,), "centre": (d,), "scale": (d,)}
        tensors, meta = load_tensors(path, "em", set(shapes))
        other = {k: meta.get(k) for k, v in self.settings.items() if meta.get(k) != v}
        for name, ours in (("centre", self.centre), ("scale", self.scale)):
            saved = tensors[name].to(ours)
            if saved.shape != ours.shape or not torch.allclose(saved, ours, rtol=1e-9, atol=1e-12):  # order of the sum
                other[name] = "of other data"
        if other:
            allowed = f"a new file, or the checkpoint of this fit: {self.settings} and the same data"
            raise BadArgument("checkpoint", f"{path}: {other}", allowed)
        for name, shape in shapes.items():
            t, dtype = tensors[name], torch.int64 if name == "reseeded" else torch.float64
            if (shape != (-1,) and t.shape != shape) or t.dtype != dtype:
                raise ModelFileError("checkpoint", f"{path}: {name} {tuple(t.shape)} {t.dtype}", str(shape))
        components = Components(tensors["weights"], tensors["means"], tensors["covariances"])
        progress = Progress(components, tensors["reseeded"], tensors["log_likelihood"], meta.get("jumped") == "True")
        return progress.to(self.centre.device)
