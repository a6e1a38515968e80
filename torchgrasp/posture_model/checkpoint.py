"""Where a fit stands, kept in a file after every step: a fit that was killed goes on at its last step."""

import dataclasses
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument, ModelFileError
from torchgrasp.files import load_tensors, save_tensors
from torchgrasp.posture_model.em import Components, Progress


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """The file of one fit, and what tells that fit from others: data, components, seeds and added variance.

    The data are known by their number, mean and standard deviation in every dimension, which are equal to the last
    bit when they are the same.

    Args:
        path: of the file; it need not exist.
        rows: how many the data are.
        centre: their mean.
        scale: their standard deviation.
        components: m.
        seed: of the first start.
        starts: how many there were.
        regularisation: relative added variance.
    """

    path: Path
    rows: int
    centre: Float[Tensor, "d"]
    scale: Float[Tensor, "d"]
    components: int
    seed: int
    starts: int
    regularisation: float

    def save(self, progress: Progress) -> None:
        """Write atomically where the fit stands.

        Raises:
            OutputError: the file cannot be written.
        """
        fields = dataclasses.fields(Components)
        tensors = {field.name: getattr(progress.components, field.name) for field in fields}
        tensors |= {"reseeded": progress.reseeded, "log_likelihood": progress.log_likelihood}
        tensors |= {"centre": self.centre, "scale": self.scale}
        meta = {**self._settings(), "jumped": str(progress.jumped)}
        save_tensors(self.path, "em", tensors, meta)

    def load(self) -> Progress | None:
        """Return where the fit stood, or None when there is no file yet.

        Raises:
            ModelFileError: the file is damaged, or no checkpoint.
            BadArgument: it is the checkpoint of another fit.
        """
        if not self.path.exists():
            return None
        m, d = self.components, len(self.centre)
        shapes = {
            "weights": (m,),
            "means": (m, d),
            "covariances": (m, d, d),
            "reseeded": (m,),
            "log_likelihood": None,
            "centre": (d,),
            "scale": (d,),
        }
        tensors, meta = load_tensors(self.path, "em", set(shapes))
        other = {k: meta.get(k) for k, v in self._settings().items() if meta.get(k) != v}
        for name, mine in (("centre", self.centre), ("scale", self.scale)):
            if not _same(tensors[name], mine):
                other[name] = "of other data"
        if other:
            allowed = f"a new file, or the checkpoint of this fit: {self._settings()} and the same data"
            raise BadArgument("checkpoint", f"{self.path}: {other}", allowed)
        for name, shape in shapes.items():
            t = tensors[name]
            if (shape and t.shape != shape) or t.dtype != (torch.int64 if name == "reseeded" else torch.float64):
                raise ModelFileError("checkpoint", f"{self.path}: {name} {tuple(t.shape)} {t.dtype}", str(shape))
        device = self.centre.device
        components = Components(*(tensors[k].to(device) for k in ("weights", "means", "covariances")))
        history = tensors["log_likelihood"].to(device)
        return Progress(components, tensors["reseeded"].to(device), history, meta.get("jumped") == "True")

    def _settings(self) -> dict[str, str]:
        return {
            "rows": str(self.rows),
            "components": str(self.components),
            "seed": str(self.seed),
            "starts": str(self.starts),
            "regularisation": repr(self.regularisation),
        }


def _same(found: Tensor, mine: Float[Tensor, "d"]) -> bool:
    """Tell whether two statistics agree up to the order in which the data were summed."""
    return found.shape == mine.shape and torch.allclose(found.to(mine), mine, rtol=1e-9, atol=1e-12)
