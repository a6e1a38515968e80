"""`torchgrasp campaign`: a data set of grasps, tried in simulation, on processes here or on a cluster."""

from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import check_seed, naming
from torchgrasp.app.cli.grasps import import_simulator
from torchgrasp.base import check_whole
from torchgrasp.campaign import CampaignSpec, run_campaign
from torchgrasp.campaign.folder import FAILED
from torchgrasp.data import JobRow
from torchgrasp.errors import BadArgument, Status
from torchgrasp.evaluation.protocols import find_protocol
from torchgrasp.evaluation.views import EvaluationSpec, Ranks
from torchgrasp.files import format_line
from torchgrasp.hand.load import load_hand
from torchgrasp.specs import ClosingMode, Simulator


def campaign(
    objects: Annotated[Positional[Path], arg(metavar="OBJECTS")],
    /,
    hand: str,
    out: Path,
    fingers: str = "default",
    protocol: Literal[
        "multidex", "dexgraspbench", "dexgraspbench-hard", "pose-noise", "paper", "tabletop", "household"
    ] = "tabletop",
    closing: ClosingMode | None = None,
    simulator: Simulator = "sapien",
    grasps: int = 20,
    ranks: Ranks = "best",
    starts: int = 1000,
    only: tuple[str, ...] = (),
    views: int | None = None,
    seed: int = 0,
    licence: str = "unknown",
    jobs_in_shard: int = 64,
    workers: int = 1,
    scheduler: str | None = None,
) -> int:
    """Write a data set: for each view its cloud, grasps, certificates, deviations, predicted and simulated success.

    Prints a line for each job, one object and view. Writes shards of safetensors with README.md and card.json, which
    torchgrasp.data.read_shards reads. The same command continues a run that was interrupted or killed, and tries
    failed jobs again: worker_died, timed_out, and broken, an error of the library. It ends with 1 while some are left.

    Args:
        objects: folder with manifest.json, and for each object mesh.ply and noisy views; see docs/data.md.
        hand: name of a shipped hand, as allegro, barrett, leap or shadow, or the folder of another.
        out: folder of the data set; no other run may use it meanwhile.
        fingers: which grasp: an option of the hand, a number of fingers, or their names as in index,middle,thumb.
        protocol: which test decides on success; see torchgrasp.evaluation.protocols.
        closing: how the hand closes; by default as the protocol says.
        simulator: sapien or mujoco.
        grasps: the most that are kept and tried of each view.
        ranks: which of them: the best, or as many spread over all ranks.
        starts: random starts of the contact planner.
        only: names of objects to keep; by default all.
        views: the most of each object; by default all.
        seed: of every random draw.
        licence: of the data set, for its card, as CC-BY-4.0.
        jobs_in_shard: jobs whose records share a file.
        workers: processes here; the data do not depend on their number. 0: this one.
        scheduler: address of a Dask scheduler, as tcp://10.0.0.1:8786, whose workers do the jobs instead.
    """
    check_seed(seed)
    check_whole("--workers", workers, 0, 1024)
    import_simulator(simulator)
    if fingers == "auto":
        raise BadArgument("--fingers", "auto", "one set of fingers for all records")
    with naming(hand="--hand", name="--hand", fingers="--fingers"):
        robot = load_hand(hand, fingers)
    changes: dict[str, Any] = {"simulator": simulator} | ({} if closing is None else {"closing": closing})
    numbers = {"grasps": "--grasps", "starts": "--starts", "views": "--views", "jobs_in_shard": "--jobs-in-shard"}
    with naming(licence="--licence", **numbers):
        trials = EvaluationSpec(grasps, ranks, starts, only=only, seed=seed, views=views)
        spec = CampaignSpec(find_protocol(protocol).with_trial(**changes), trials, licence, jobs_in_shard)
    source = "--workers" if scheduler is None else "--scheduler"
    with naming(objects="OBJECTS", folder="--out", path="--out", workers=source):
        data = run_campaign(objects, robot, out, spec, workers if scheduler is None else scheduler, print_job)
    counts = data.card["counts"]
    said = ", ".join(f"{n} {name.lower()}" for name, n in counts["status"].items())
    print(f"{counts['jobs']} jobs: {said}")
    print(f"{len(data)} grasps, {counts['passed']} of {counts['tries']} tries passed: {out}")
    failed = [row for row in data.jobs if row.status in FAILED]
    if failed:
        reasons = ", ".join(sorted({row.status.name.lower() for row in failed}))
        jobs = "1 job" if len(failed) == 1 else f"{len(failed)} jobs"
        print(f"{jobs} failed by no fault of the object ({reasons}): the same command tries again")
    return 1 if failed else 0


def print_job(row: JobRow) -> None:
    """Print the line of a job that was done."""
    reason = "" if row.status is Status.OK else row.note or row.status.sentence
    numbers = row.executable, f"{row.passed}/{row.grasps}"
    print(format_line((row.object, row.view, *numbers, reason), (-12, -6, 5, 7, -1)), flush=True)
