"""The posture model of mode "paper": the hand's postures that can hold something, of all sizes
alike.

python scripts/train.py paper_model allegro
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import torch
import tyro

from torchgrasp import fit_mixture, load_hand
from torchgrasp.posture_model import HandSamples
from torchgrasp.posture_model.sample import sample_configurations

COMPONENTS = {"allegro": 41, "barrett": 60}
"""Numbers of Gaussians: the paper's for the Allegro hand; for the Barrett hand that of
`mixture.safetensors`.
"""
STEP = 0.005
SIZES = (0.01, 0.07)
"""Width [m] of the classes of size that are made equally likely, and the range of sizes that is
taken.
"""


def paper_model(
    hand: Annotated[str, tyro.conf.Positional], out: Path | None = None, drawn: int = 200_000
) -> None:
    """Learn the posture model that `plan_grasps(mode="paper")` asks by Eq. (21).

    Most random postures are wide open. So a model of all of them knows few triples of the size of
    an object. Here every size, the mean distance of the fingertips from their centre, is equally
    likely.

    Args:
        hand: by name.
        out: file of the model; by default `paper.safetensors` in the hand's folder.
        drawn: postures that are drawn; a fifth of them is taken.
    """
    one = load_hand(hand)
    samples = even_sizes(sample_configurations(one, drawn, sampling="grasping"), drawn // 5)
    model = fit_mixture(samples, COMPONENTS[hand])
    meta = model.meta | {"sizes": f"evenly from {SIZES[0]:g} to {SIZES[1]:g} m"}
    print(
        dataclasses.replace(model, meta=meta).save(
            out or one.urdf_path.parent / "paper.safetensors"
        )
    )


def even_sizes(samples: HandSamples, count: int) -> HandSamples:
    """Return `count` of the sampled postures, drawn so that all sizes are about equally likely.

    The size of a posture is the mean distance [m] of its fingertips from their centre. Sizes
    outside the limits `SIZES` are left out.
    """
    size = samples.q[:, :3].mean(1)
    group = (size / STEP).long()
    weight = 1.0 / torch.bincount(group)[group].double()
    weight[(size < SIZES[0]) | (size > SIZES[1])] = 0
    generator = torch.Generator().manual_seed(0)
    return samples[torch.multinomial(weight, count, replacement=False, generator=generator)]
