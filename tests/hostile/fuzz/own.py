"""Small good files of every kind that the library writes for itself, each with its reader."""

import shutil
from pathlib import Path

import torch
import trimesh

from tests.campaign.cheap import campaign, work_on
from tests.hostile.fuzz.cases import Case, saved
from torchgrasp import GraspMixture, fit_mixture, load_grasps, load_hand, load_mixture
from torchgrasp.campaign.folder import carry_out
from torchgrasp.control.paper.stability import load_stability
from torchgrasp.data import read_shards
from torchgrasp.data.shipped import load_shipped_grasp
from torchgrasp.export import format_grasps, format_moveit
from torchgrasp.hand import hand_of
from torchgrasp.hand.load import hands_folder
from torchgrasp.posture_model import HandSamples, SampleSpec, load_samples, write_samples
from torchgrasp.posture_model.mixture import CODE_NAMES
from torchgrasp.sim.convex_parts import _load, _save  # pyright: ignore[reportPrivateUsage]
from torchgrasp.values.planning import Certificate, Contacts, Grasps


def models(folder: Path) -> list[Case]:
    """Return grasps, mixtures, a stability model and a chunk of samples, small where they can be."""
    one = torch.ones(2)
    two = torch.ones(2, 3)
    contacts = Contacts(
        torch.rand(2, 3, 3), torch.eye(3).expand(2, 3, 3).contiguous(), torch.rand(2, 3)
    )
    certificate = Certificate(one, one, one, one > 0, torch.ones(2, 6))
    pose = torch.eye(4).repeat(2, 1, 1)
    status = torch.zeros(2, dtype=torch.int64)
    direction = torch.eye(3)[:2]
    order = torch.arange(3).repeat(2, 1)
    Grasps(
        two,
        two,
        direction,
        pose,
        contacts,
        order,
        two,
        one,
        two,
        certificate,
        one,
        status,
        {"hand": "barrett"},
    ).save(folder / "grasps.safetensors")
    half = torch.full((1, 7), 0.5, dtype=torch.float64)
    eye = torch.eye(7, dtype=torch.float64)[None]
    mixture = GraspMixture(torch.ones(1, dtype=torch.float64), half, eye, ("j", *CODE_NAMES))
    mixture.save(folder / "mixture.safetensors")
    hand = load_hand("barrett")
    write_samples(hand, SampleSpec(20), folder / "samples")
    shutil.copy(hands_folder() / "barrett" / "stability.safetensors", folder)
    return [
        saved(folder / "grasps.safetensors", load_grasps),
        saved(folder / "mixture.safetensors", load_mixture),
        saved(folder / "stability.safetensors", lambda x: load_stability(hand, x)),
        saved(
            folder / "samples" / "chunk-000000.safetensors", lambda x: load_samples(x.parent).read()
        ),
    ]


def shown(folder: Path) -> list[Case]:
    """Return grasps, as the commands take them that write or show them."""
    hand = load_hand("barrett")
    load_shipped_grasp("jug", "barrett").save(folder / "grasps.safetensors")

    def read(path: Path) -> None:
        grasps = load_grasps(path)
        hand_of(grasps, "barrett"), format_grasps(hand, grasps), format_moveit(hand, grasps)

    return [saved(folder / "grasps.safetensors", read)]


def samples(folder: Path) -> list[Case]:
    write_samples(load_hand("barrett"), SampleSpec(20), folder)
    return [saved(folder / "samples.json", lambda x: load_samples(x.parent).read())]


def shards(folder: Path) -> list[Case]:
    """Return what a campaign left: its card, a shard, and what was asked, which is compared when it
    is continued.
    """
    asked = campaign(3)
    carry_out(asked, folder, work_on(asked, 0))

    def read(path: Path) -> None:
        data = read_shards(path.parent)
        for j in range(len(data.jobs)):
            data.job(j)
        for g in range(len(data)):
            data[g]

    def go_on(path: Path) -> None:
        carry_out(asked, path.parent, work_on(asked, 0))

    readers = {"card.json": read, "shard-000000.safetensors": read, "campaign.json": go_on}
    return [saved(folder / name, reader) for name, reader in readers.items()]


def checkpoints(folder: Path) -> list[Case]:
    """Return the checkpoint of a fit, which goes on from it."""
    rows = torch.rand(40, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    postures = HandSamples(rows[:, :1], rows[:, 1:], ("knuckle",))

    def fit(path: Path) -> None:
        fit_mixture(postures, 2, iterations=3, checkpoint=path)

    fit(folder / "step.safetensors")
    return [saved(folder / "step.safetensors", fit)]


def parts(folder: Path) -> list[Case]:
    ball = trimesh.creation.icosahedron().apply_scale(0.05)
    _save([ball, ball.copy().apply_translation([0.01, 0.0, 0.0])], folder / "parts.safetensors")
    return [saved(folder / "parts.safetensors", lambda x: _load(x, ball))]


MAKERS = (models, shown, samples, shards, checkpoints, parts)
