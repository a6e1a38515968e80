"""A box with one view, and a campaign on it."""

from pathlib import Path

import pytest
import trimesh

from torchgrasp import load_hand
from torchgrasp.campaign import CampaignSpec, run_campaign
from torchgrasp.data import write_objects
from torchgrasp.evaluation import PROTOCOLS, EvaluationSpec

LIFT = PROTOCOLS["tabletop"].with_trial(hold_time=0.1, control_rate=50.0)
QUICK = CampaignSpec(LIFT, EvaluationSpec(2, "spread", starts=6))


@pytest.fixture(scope="session")
def carton(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("carton")
    (folder / "meshes").mkdir()
    trimesh.creation.box((0.05, 0.06, 0.12)).export(folder / "meshes" / "carton.ply")
    write_objects(folder / "meshes", folder / "objects", views=1)
    return folder / "objects"


@pytest.fixture(scope="session")
def data(carton: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sapien")
    out = tmp_path_factory.mktemp("data")
    run_campaign(carton, load_hand("barrett"), out, QUICK)
    return out
