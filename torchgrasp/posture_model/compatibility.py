"""Whether a model fits a hand, tested by what the model depends on: joints, limits and fingertips."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.errors import BadArgument
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.encoding import encode_fingertips

CODE_TOLERANCE = 1e-5
"""Largest difference of two codes [m or cosine] by rounding: `describe_compatibility` writes seven digits."""


def describe_compatibility(hand: Hand) -> dict[str, str]:
    """Return the metadata of samples and models about their hand: name, fingers, hash of its files, some codes."""
    codes = " ".join(f"{x:.7f}" for x in _probe_codes(hand).flatten().tolist())
    return {"hand": hand.name, "fingers": hand.source.option, "hand_sha256": hand.source.sha256, "hand_codes": codes}


def check_compatible(meta: dict[str, str], joint_names: tuple[str, ...], hand: Hand) -> None:
    """Refuse a model of another hand, fingers, limits or fingertips; without `hand_codes`, of other joint names."""
    if joint_names != hand.joint_names:
        raise BadArgument("mixture", f"joints {joint_names}", f"the joints {hand.joint_names} of the hand")
    if "hand_codes" not in meta:
        return
    ours = _probe_codes(hand).flatten()
    try:
        theirs = torch.tensor([float(x) for x in meta["hand_codes"].split()], dtype=torch.float64)
    except ValueError as error:
        raise BadArgument("mixture", f"hand_codes {meta['hand_codes']!r}", "numbers") from error
    if theirs.shape != ours.shape or not torch.allclose(theirs.to(ours), ours, rtol=0, atol=CODE_TOLERANCE):
        whose = f"hand {meta.get('hand')!r}, fingers {meta.get('fingers')!r}, of other limits or fingertips"
        allowed = f"one of {hand.name!r}, {hand.source.option!r}: train it anew"
        raise BadArgument("mixture", f"a model of {whose}", allowed)


def _probe_codes(hand: Hand) -> Float[Tensor, "3 q"]:
    """Return the codes of three postures between the limits; they depend on limits, links and fingertips."""
    lower, upper = hand.lower.double(), hand.upper.double()
    share = torch.tensor([0.2, 0.5, 0.7], dtype=torch.float64, device=lower.device)
    index = (torch.arange(hand.dof)[None] + torch.arange(3)[:, None]) % 3
    return encode_fingertips(*hand.fingertips(lower + share[index] * (upper - lower)))
