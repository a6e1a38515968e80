"""Reads data sets as others do: python foreign.py tables|episodes OUT FOLDERS, in the environment
.beside/lerobot.

What is read goes to OUT as JSON, so that the caller, which has none of these packages, can compare
it.
"""

import json
import os
import sys
import types
from pathlib import Path

import numpy as np


def tables(folder: str) -> dict[str, object]:
    """Read both tables with Hugging Face's datasets, and their records with Croissant's own reader."""
    import mlcroissant
    from datasets import load_dataset

    read = {
        "grasps": load_dataset(folder, split="train"),
        "views": load_dataset(folder, "views", split="train"),
    }
    found: dict[str, object] = {
        f"{name}.types": {k: str(x) for k, x in t.features.items()} for name, t in read.items()
    }
    found |= {f"{name}.rows": table[:] for name, table in read.items()}
    card = mlcroissant.Dataset(
        f"{folder}/croissant.json"
    )  # raises an error for a card that is not valid
    for name in read:
        records = [
            {key.split("/")[1]: plain(x) for key, x in row.items()} for row in card.records(name)
        ]
        found[f"{name}.records"] = {key: [row[key] for row in records] for key in records[0]}
    return found | {"name": card.metadata.name, "errors": sorted(card.metadata.issues.errors)}


def episodes(folder: str) -> dict[str, object]:
    """Read all frames with LeRobot's loader, and compute their statistics with LeRobot's own
    functions.
    """
    import datasets  # looks for torchvision before it is replaced

    # LeRobot imports torchvision for pictures, of which the episodes have none; its builds of PyPI
    # need a CUDA torch.
    vision = types.ModuleType("torchvision")
    vision.transforms = types.ModuleType("torchvision.transforms")
    sys.modules |= {"torchvision": vision, "torchvision.transforms": vision.transforms}
    from lerobot.datasets.compute_stats import compute_episode_stats
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.datasets.utils import dataset_to_policy_features

    whole = LeRobotDataset("closings", root=folder, delta_timestamps={"action": [0.0, 0.01]})
    second = LeRobotDataset("closings", root=folder, episodes=[1])
    frames = [whole[i] for i in range(len(whole))]
    columns = {
        key: np.array([np.asarray(frame[key]) for frame in frames]) for key in whole.features
    }
    one = {key: x[:, 0] if key == "action" else x for key, x in columns.items()}
    floats = {key: x.astype(float) for key, x in one.items()}
    found = {
        "frames": {key: x.tolist() for key, x in columns.items()},
        "tasks": [frame["task"] for frame in frames],
    }
    found["names"] = {key: feature["names"] for key, feature in whole.features.items()}
    found["stats"] = {
        key: {k: x.tolist() for k, x in of.items()} for key, of in whole.meta.stats.items()
    }
    theirs = compute_episode_stats(floats, whole.features)
    found["theirs"] = {key: {k: x.tolist() for k, x in of.items()} for key, of in theirs.items()}
    found["policy"] = {
        key: [x.type.name, *x.shape]
        for key, x in dataset_to_policy_features(whole.features).items()
    }
    found["second"] = [len(second), second[0]["task"], second[0]["index"].item()]
    found["rows"] = len(datasets.load_dataset(folder, split="train"))
    return found | {
        "fps": whole.fps,
        "robot": whole.meta.robot_type,
        "episodes": whole.num_episodes,
    }


def plain(value: object) -> object:
    """Return a record's value for JSON: Croissant reads texts as bytes, and numbers as NumPy's."""
    if isinstance(value, list | np.ndarray):
        return [plain(x) for x in value]
    if isinstance(value, bytes):
        return value.decode()
    return value.item() if isinstance(value, np.generic) else value


if __name__ == "__main__":
    assert os.environ["HF_HUB_OFFLINE"] == "1"
    kind, out, *folders = sys.argv[1:]
    read = {"tables": tables, "episodes": episodes}[kind]
    Path(out).write_text(json.dumps([read(folder) for folder in folders]))
