"""From bare meshes to a data set of grasps that were tried in simulation, and to batches for
learning.

The same on files: `torchgrasp cloud views MESHES --out OBJECTS`, then `torchgrasp campaign OBJECTS
--hand barrett ...`.
"""

import tempfile
from pathlib import Path

import torch
import trimesh

from torchgrasp import load_hand
from torchgrasp.campaign import CampaignSpec, run_campaign
from torchgrasp.data import read_shards, write_objects
from torchgrasp.evaluation import EvaluationSpec

folder = Path(tempfile.mkdtemp())
(folder / "meshes").mkdir()  # your own: closed meshes in metres, z up
trimesh.creation.cylinder(radius=0.03, height=0.12).export(folder / "meshes" / "tin.ply")
trimesh.creation.box((0.05, 0.06, 0.12)).export(folder / "meshes" / "carton.ply")
write_objects(folder / "meshes", folder / "objects", views=1)

# of each view two grasps, the best and the worst
trials = EvaluationSpec(grasps=2, ranks="spread", starts=40)
spec = CampaignSpec("tabletop", trials, licence="CC0-1.0")
run_campaign(folder / "objects", load_hand("barrett"), folder / "data", spec, observer=print)

# a map-style dataset; here from another day's process
data = read_shards(folder / "data", points=256)
for batch in torch.utils.data.DataLoader(
    data, batch_size=2, shuffle=True, generator=torch.Generator().manual_seed(0)
):
    points = batch["points"]
    joints = batch["joints"]
    success = batch["simulated"]
    print(
        tuple(points.shape),
        tuple(joints.shape),
        "simulated",
        success.tolist(),
        "of jobs",
        batch["job"].tolist(),
    )

job = data.job(0)  # or whole: the cloud, and `Grasps` in full precision
print(
    f"{job.row.object}: {job.row.executable} executable, certificate margins {job.grasps.certificate.margin.numpy()}"
)
