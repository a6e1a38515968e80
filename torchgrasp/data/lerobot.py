"""Simulated closings as episodes of a LeRobot data set (v3.0), to train policies on."""

import hashlib
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchgrasp.data.table_folder import (
    as_table,
    import_arrow,
    pack_table,
    render_card,
    write_folder,
)
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.lazy import spatial
from torchgrasp.hand.hand import Hand
from torchgrasp.values.closing import ClosureResult

Episodes = Sequence[tuple[str, ClosureResult]]  # each closing with its task in words
PERCENTILES = (1, 10, 50, 90, 99)
"""The quantiles that LeRobot's statistics hold."""
RATE_DECIMALS = 6  # to which rates [Hz] are rounded before they are compared


@checked
def write_lerobot(folder: Path | str, episodes: Episodes, hand: Hand) -> Path:
    """Write simulated closings as a LeRobot data set (v3.0), to train policies on; return the
    folder.

    `LeRobotDataset(name, root=folder)` reads it. Each closing is an episode. Each control tick, a
    period of the controller, is a frame of the episode, except the last one. Positions [m] and
    quaternions (x, y, z, w) are in the coordinate frame of the planned cloud. The pose of the hand
    and its frame are those of its root link. There are no images and no rewards.

    | feature | contents |
    | --- | --- |
    | `observation.state` | all movable joints [rad or m] of the URDF, then position and quaternion of the hand |
    | `observation.forces` | force (x, y, z) [N] of each fingertip on the object, in the hand's frame |
    | `observation.environment_state` | position and quaternion of the object |
    | `action` | the next tick's joint targets [rad or m], then the hand's pose after that tick |
    | `next.done` | whether this frame is the last one of the episode |
    | `next.success` | whether this frame is the last one, and the object was held |

    Args:
        folder: the folder to write.
        episodes: pairs of a task in words and the `ClosureResult` of `close_hand`.
        hand: the hand of all closings, with their fingers.

    Raises:
        BadArgument: there is no closing, or a closing has a single tick.
        BadArgument: a closing has numbers that are not finite.
        BadArgument: a closing is of another hand or of other fingers, or has another control rate
            than the first one.
        OutputError: the folder holds other files, or cannot be written.
        MissingExtra: pyarrow is not installed.

    >>> import tempfile
    >>> from torchgrasp import TrialSpec, close_hand, load_hand, load_object
    >>> from torchgrasp.data import load_shipped_grasp
    >>> jug, hand = load_object("jug"), load_hand("barrett")
    >>> grasp = load_shipped_grasp("jug", "barrett")
    >>> closing = close_hand(grasp, hand, jug.mesh, TrialSpec(hold_time=0.1), parts=jug.parts)
    >>> folder = write_lerobot(Path(tempfile.mkdtemp(), "jug"), [("lift the jug", closing)], hand)
    >>> json.loads((folder / "meta" / "info.json").read_text())["features"]["action"]["names"][:3]
    ['spread', 'spread_mimic', 'f1_flex']
    """
    import_arrow()
    joints = sorted(hand.tree.joint_names)
    rates = list[float]()
    for i, (_, x) in enumerate(episodes):
        rates.append(
            round(1 / float(x.time[1] - x.time[0]), RATE_DECIMALS) if len(x.time) > 1 else 0.0
        )
        same = sorted(x.joint_names) == joints and x.forces.shape[1] == len(hand.finger_names)
        # forces are named by the fingers
        same = same and x.finger_names in ((), hand.finger_names)
        if not same or not rates[i] or rates[i] != rates[0]:
            found = f"{len(x.time)} ticks at {rates[i]:g} Hz of {len(x.joint_names)} joints"
            found += f", fingers {', '.join(x.finger_names)}" if x.finger_names else ""
            allowed = (
                f"a closing of {hand.name} with the fingers {', '.join(hand.finger_names)}, two "
                "ticks or more, all at one rate"
            )
            raise BadArgument(f"episodes[{i}]", found, allowed)
        _check_finite(f"episodes[{i}]", x)
    if not rates:
        raise BadArgument("episodes", "none", "at least one closing")
    files = dict(_files(episodes, hand, rates[0]))
    digest = hashlib.sha256(b"".join(x for x in files.values() if isinstance(x, bytes))).hexdigest()
    return write_folder(folder, {"torchgrasp": "lerobot", "frames_sha256": digest}, files.items())


def _check_finite(name: str, closing: ClosureResult) -> None:
    """Raise `BadArgument` for a closing with numbers that are not finite, as of a simulation that
    diverged: a single one would spoil the statistics of the whole data set.
    """
    # a simulation that diverges ends with that tick, which has no observation
    written = {
        "joints": closing.joints[:-1],
        "object_pose": closing.object_pose[:-1],
        "trace.forces": closing.trace.forces[:-1],
        "targets": closing.targets,
        "hand_pose": closing.hand_pose,
    }
    wrong = [key for key, x in written.items() if not bool(torch.isfinite(x).all())]
    if wrong:
        found = f"{', '.join(wrong)} that are not finite, of status {closing.status.name}"
        raise BadArgument(name, found, "finite numbers: leave out closings that diverged")


def _files(episodes: Episodes, hand: Hand, rate: float) -> Iterator[tuple[str, str | bytes]]:
    """Yield names and contents of the files, `meta/info.json` at the end."""
    file = "chunk-000/file-000.parquet"
    tasks = list(dict.fromkeys(task for task, _ in episodes))
    parts = [_frames(x, hand, rate, i, tasks.index(task)) for i, (task, x) in enumerate(episodes)]
    frames = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    ends = [0, *itertools.accumulate(len(part["action"]) for part in parts)]
    frames["index"] = torch.arange(ends[-1])
    spans = itertools.pairwise(ends)
    rows = [_episode_row(frames, i, episodes[i][0], *span) for i, span in enumerate(spans)]
    yield f"data/{file}", pack_table(as_table(frames, {}))
    yield f"meta/episodes/{file}", pack_table(import_arrow().Table.from_pylist(rows))
    columns = {"task_index": torch.arange(len(tasks)), "task": tasks}
    words = as_table(columns, {"pandas": render_card("tasks.json")})
    yield "meta/tasks.parquet", pack_table(words)
    yield "meta/stats.json", json.dumps({name: _stats(x) for name, x in frames.items()}, indent=1)
    about = {
        "hand": hand,
        "rate": rate,
        "episodes": rows,
        "frames": ends[-1],
        "tasks": tasks,
        "features": _features(frames, hand),
    }
    yield "README.md", render_card("lerobot.md", **about)
    yield "meta/info.json", render_card("info.json", **about)


def _frames(
    closing: ClosureResult, hand: Hand, rate: float, episode: int, task: int
) -> dict[str, Tensor]:
    """Return the features of a closing's frames: all its ticks but the last one, after which
    nothing is done.
    """
    # simulators have their own order of joints
    order = [closing.joint_names.index(name) for name in hand.tree.joint_names]
    palm = _numbers(closing.hand_pose)
    number = torch.arange(len(palm) - 1)
    done = number == number[-1]
    return {
        "observation.state": torch.cat([closing.joints[:, order], palm], 1)[:-1].float(),
        "observation.forces": closing.trace.forces.flatten(1)[:-1].float(),
        "observation.environment_state": _numbers(closing.object_pose)[:-1].float(),
        "action": torch.cat([closing.targets[:, order], palm], 1)[1:].float(),
        "next.done": done,
        "next.success": done & closing.held,
        "timestamp": (number / rate).float(),
        "frame_index": number,
        "episode_index": torch.full_like(number, episode),
        "task_index": torch.full_like(number, task),
    }


def _episode_row(
    frames: dict[str, Tensor], episode: int, task: str, start: int, end: int
) -> dict[str, Any]:
    """Return what LeRobot stores about an episode, whose frames are those from `start` to `end`."""
    row: dict[str, Any] = {"episode_index": episode, "tasks": [task], "length": end - start}
    row |= {"dataset_from_index": start, "dataset_to_index": end}
    for of in ("data", "meta/episodes"):
        row |= {f"{of}/chunk_index": 0, f"{of}/file_index": 0}
    for name, x in frames.items():
        row |= {f"stats/{name}/{key}": some for key, some in _stats(x[start:end]).items()}
    return row


def _features(frames: dict[str, Tensor], hand: Hand) -> dict[str, dict[str, Any]]:
    """Return the type, the shape and the names of the numbers of each feature."""
    pose = ("x", "y", "z", "qx", "qy", "qz", "qw")
    state = [*hand.tree.joint_names, *(f"hand.{x}" for x in pose)]
    names = {
        "action": state,
        "observation.state": state,
        "observation.environment_state": [f"object.{x}" for x in pose],
        "observation.forces": [
            f"{finger}.{axis}" for finger in hand.finger_names for axis in "xyz"
        ],
    }
    return {
        name: {
            "dtype": str(x.dtype).removeprefix("torch."),
            "shape": [*x.shape[1:]] or [1],
            "names": names.get(name),
        }
        for name, x in frames.items()
    }


def _numbers(poses: Float[Tensor, "t 4 4"]) -> Float[Tensor, "t 7"]:
    """Return poses as positions [m] and quaternions (x, y, z, w), whose signs do not jump."""
    rotations = spatial.transform.Rotation.from_matrix(poses[:, :3, :3].numpy())
    turns = torch.from_numpy(rotations.as_quat(canonical=True))
    signs = torch.where((turns[1:] * turns[:-1]).sum(1) < 0, -1.0, 1.0).cumprod(0)
    turns[1:] *= signs[:, None]
    return torch.cat([poses[:, :3, 3], turns], 1)


def _stats(column: Tensor) -> dict[str, list[Any]]:
    """Return statistics of each number of a feature over all frames, named as in LeRobot."""
    x = column.double().reshape(len(column), -1).numpy()
    found = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0)}
    found |= {f"q{q:02d}": np.quantile(x, q / 100.0, axis=0) for q in PERCENTILES}
    return {name: numbers.tolist() for name, numbers in found.items()} | {"count": [len(x)]}
