"""What a campaign of a million views costs: rates of a few views measured here, and from them a
plan on paper.
"""

import dataclasses
import json
import os
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from benchmarks.common import Options, Row, bench
from torchgrasp import load_hand
from torchgrasp.campaign import cluster
from torchgrasp.data import list_views, manifest, read_object_mesh, write_objects
from torchgrasp.data.shards import load_shard, read_row
from torchgrasp.evaluation import PROTOCOLS, EvaluationSpec
from torchgrasp.evaluation.views import ObjectView
from torchgrasp.files import Field, format_json, write_file
from torchgrasp.foundation.errors import ModelFileError
from torchgrasp.foundation.limits import JSON_BYTES
from torchgrasp.sim.convex_parts import convex_parts

MILLION = 1_000_000
HOUR = 3600.0
DAY = 24 * 3600.0
YEAR = 365.25 * 24 * 3600.0
CORES = (64, 1024)
GPUS = (1, 8, 64)
BESIDE = 16  # cores beside each GPU, as in the machines that were lent
TRIED = 20  # grasps of a view that a campaign tries by default
DEATHS = (
    1e-3  # deaths of a worker in an hour: a guess, a machine of 64 workers dies twice a month or so
)
# deaths of one job's workers in one call, by Dask's default, until the row says `WORKER_DIED`
FAILURES = 4
FOLDER = 10_000  # objects of a folder in the plan, one campaign each
CARD_BYTES = 256 * 1024**2  # largest card that `read_shards` opens
JOBS_IN_SHARD = 64


class Rates(NamedTuple):
    """What one view costs on one core [s], and what it leaves; means over the views measured."""

    plan: float
    trial: float  # of one try
    tries: float  # of a view, when 20 are asked for: views without grasps have none
    parts: float  # convex parts of the mesh, once for each object and machine
    rest: float  # reading and packing
    executable: float
    record: float  # bytes of a job that are no grasp's
    grasp: float  # bytes of a grasp that was tried
    row: float  # bytes of a job in the card
    index: float  # bytes of a job in the memory of `read_shards`
    reads: float  # how often a job reads the manifest
    entry: float  # bytes of an object in the manifest of `write_objects`, one view each
    parse: float  # seconds to read the manifest of a folder of `FOLDER` objects

    @property
    def bytes(self) -> float:
        """Bytes of a view in a shard."""
        return self.record + self.tries * self.grasp

    @property
    def tried(self) -> float:
        """Seconds of a core for a view whose grasps are planned elsewhere."""
        return self.tries * self.trial + self.parts + self.rest + self.reads * self.parse

    def views_per_hour(self, cores: int, gpus: int = 0, clouds: float = 0.0) -> float:
        """Return the views of an hour on some cores, if they plan, or GPUs that plan so many clouds
        a second do.
        """
        if not gpus:
            return HOUR * cores / (self.tried + self.plan)
        return HOUR * min(gpus * clouds, cores / self.tried)


@bench("load/campaign", objects=True)
def campaign(o: Options) -> list[Row]:
    """Plan and try a few views here; print views an hour on other machines, bytes, faults and
    limits.
    """
    rates, measured = measure(o)
    rows = [measured]
    for cores in CORES:
        rows.append(
            _fleet(f"{cores} cores, which plan and try", rates, rates.views_per_hour(cores), cores)
        )
    for gpus in GPUS:
        cores = BESIDE * gpus
        what = f"{gpus} GPUs that plan, {BESIDE * gpus} cores that try"
        bound = rates.views_per_hour(cores, gpus, float("inf"))
        if o.gpu_rate is None:
            text = f"not measured: --gpu-rate; the cores try {bound:.0f} views an hour at most"
            rows.append(Row(what, "-", text, None, {"most": bound}))
            continue
        found = rates.views_per_hour(cores, gpus, o.gpu_rate)
        need = o.gpu_rate * rates.tried
        rows.append(
            _fleet(
                what,
                rates,
                found,
                cores,
                f"; a GPU of {o.gpu_rate:g} clouds/s feeds {need:.0f} cores",
            )
        )
    return [*rows, *plan(rates)]


def measure(o: Options) -> tuple[Rates, Row]:
    """Run the jobs of a campaign on the views asked for, one after another, and return their means."""
    hand = load_hand(o.hands[0])
    protocol = PROTOCOLS["tabletop"]
    spec = EvaluationSpec(o.grasps, "spread", o.starts)
    protocol = protocol.with_trial(simulator=o.simulator)
    meta = {"campaign": "0" * 64, "versions": json.dumps(cluster.versions())}
    views = [
        ObjectView(Path(folder).resolve(), name, view, hand.source)
        for folder in o.objects
        for name, view in list_views(folder, only=o.names, most=1)
    ]
    spent = dict.fromkeys(("plan", "try", "parts", "reads", "job"), 0.0)
    found = []
    sizes = []
    status = []
    with (
        tempfile.TemporaryDirectory() as made,
        mock.patch.dict(os.environ, {"XDG_CACHE_HOME": made}),
    ):
        with (
            mock.patch.object(cluster, "plan_view", _clocked(cluster.plan_view, spent, "plan")),
            mock.patch.object(cluster, "try_grasp", _clocked(cluster.try_grasp, spent, "try")),
            mock.patch.object(
                manifest,
                "_read_fields",
                _clocked(manifest._read_fields, spent, "reads", count=True),
            ),
        ):
            for view in views:
                began = sum(os.times()[:4])  # of this process and of CoACD's
                convex_parts(read_object_mesh(view.objects, view.object))
                spent["parts"] += sum(os.times()[:4]) - began
                spent["reads"] -= 1  # that of this line
                began = time.process_time()
                file = write_file(
                    Path(made) / "job.safetensors", cluster.run_job(view, protocol, spec, meta)
                )
                spent["job"] += time.process_time() - began
                (row,), records = load_shard(file, meta)
                found.append(row)
                sizes.append((file.stat().st_size, records.grasps))
                status.append(row.status.name)
        entry, parse, bare, index = _sizes(Path(made))
    n = len(views)
    tries = sum(row.grasps for row in found)
    of_grasps = [sum(x.numel() * x.element_size() for x in _tensors(grasps)) for _, grasps in sizes]
    grasp = sum(of_grasps) / max(1, tries)
    record = sum(size for size, _ in sizes) / n - sum(of_grasps) / n
    rates = Rates(
        spent["plan"] / n,
        spent["try"] / max(1, tries),
        sum(min(TRIED, row.executable) for row in found) / n,
        spent["parts"] / n,
        (spent["job"] - spent["plan"] - spent["try"]) / n,
        sum(row.executable for row in found) / n,
        record,
        grasp,
        bare,
        index,
        spent["reads"] / n,
        entry,
        parse,
    )
    counts = ", ".join(f"{status.count(name)} {name.lower()}" for name in dict.fromkeys(status))
    text = (
        f"plan {rates.plan:.2f} s, try {rates.trial:.2f} s of {tries} tries, convex parts {rates.parts:.1f} s once an"
        f" object, rest {rates.rest:.2f} s; {rates.executable:.0f} executable a view, {rates.tries:.1f} tries of"
        f" {TRIED} asked for; {counts}; {rates.bytes / 1024:.0f} KiB a view with them"
    )
    what = f"{n} views of {hand.name}, {o.starts} starts, {o.grasps} tries each in {o.simulator}, one thread"
    return rates, Row(what, "-", text, None, rates._asdict())


def plan(rates: Rates) -> list[Row]:
    """Return the plan for a million objects of one view each: storage, indices, limits and faults."""
    shards = -(-MILLION // JOBS_IN_SHARD)
    folders = -(-MILLION // FOLDER)
    most_objects = JSON_BYTES / rates.entry
    most_jobs = CARD_BYTES / rates.row
    seconds = rates.tried + rates.plan
    chance = DEATHS * seconds / HOUR

    def row(what: str, bar: str, text: str, met: bool | None = None, **numbers: float) -> Row:
        return Row(what, bar, text, met, numbers)

    return [
        row(
            "storage of a million views",
            "-",
            f"{MILLION * rates.bytes / 1e9:.0f} GB in {shards} shards of {JOBS_IN_SHARD} jobs,"
            f" {JOBS_IN_SHARD * rates.bytes / 1e6:.1f} MB each; {MILLION * rates.tries / 1e6:.1f} million grasps",
        ),
        row(
            "folder of objects: what breaks first",
            f"{JSON_BYTES // 1024**2} MiB of manifest",
            f"{rates.entry:.0f} bytes an object, so {most_objects:.0f} objects at most: a million need"
            f" {-(-MILLION // int(most_objects))} folders; a job reads the manifest {rates.reads:.1f} times,"
            f" {rates.parse:.2f} s each in a folder of {FOLDER}",
            most_objects >= MILLION,
            most=most_objects,
        ),
        row(
            "card of a data set: what breaks next",
            f"{CARD_BYTES // 1024**2} MiB",
            f"{rates.row:.0f} bytes a job, so {most_jobs:.0f} jobs at most; {rates.index:.0f} bytes a job in the"
            f" memory of a reader, {MILLION * rates.index / 2**30:.2f} GiB for a million",
            most_jobs >= MILLION,
            most=most_jobs,
        ),
        row(
            f"the plan: {folders} campaigns of {FOLDER} objects",
            "-",
            f"each {FOLDER * rates.entry / 2**20:.1f} MiB of manifest, {FOLDER * rates.row / 2**20:.1f} MiB of card,"
            f" {-(-FOLDER // JOBS_IN_SHARD)} shards, {FOLDER * rates.bytes / 1e9:.2f} GB;"
            f" {DAY / seconds * 64 / FOLDER:.1f} of them a day on 64 cores",
        ),
        row(
            f"faults at {DEATHS:g} deaths of a worker an hour (a guess)",
            "-",
            f"the worker of a job of {seconds:.0f} s dies with {chance:.1e}: {MILLION * chance:.0f} of a million jobs"
            f" begin again, {MILLION * chance**FAILURES:.0e} die {FAILURES} times and are told as worker_died",
            chance=chance,
        ),
    ]


def _fleet(what: str, rates: Rates, views: float, cores: int, more: str = "") -> Row:
    """Return the row of a fleet: views and grasps an hour, and the time of a million views."""
    text = (
        f"{views:.0f} views an hour, {views * rates.tries:.0f} tried grasps, {views * rates.bytes / 1e9:.2f} GB;"
        f" a million in {MILLION / views / 24:.1f} days{more}"
    )
    return Row(what, "-", text, None, {"views": views, "cores": cores})


def _sizes(made: Path) -> tuple[float, float, float, float]:
    """Return the bytes of an object in a manifest, the seconds to read one of `FOLDER` objects, and
    bytes of a row.

    A row has bytes in the card, and in the memory of a reader.
    """
    import trimesh

    trimesh.creation.box((0.05, 0.06, 0.12)).export(made / "carton.stl")
    write_objects(made, made / "objects", views=1)
    path = made / "objects" / "manifest.json"
    (entry,) = json.loads(path.read_text("utf-8"))["objects"].values()
    write_file(path, format_json({"objects": {f"object-{k:06}": entry for k in range(FOLDER)}}))
    began = time.process_time()
    manifest.read_entry(path.parent, "object-000000")
    parse = time.process_time() - began
    row = cluster.JobRow(
        "object-000000", "view0", family="family-0000", group="solid", executable=100, points=1000
    )
    bare = {name: x for name, x in row.as_json().items() if name != "meta"}
    texts = [format_json(bare | {"object": f"object-{k:06}"}) for k in range(FOLDER)]
    fields = [
        Field(path, "jobs", json.loads(text), lambda *words: ModelFileError("folder", *words))
        for text in texts
    ]
    tracemalloc.start()
    kept = [read_row(field, bare=True) for field in fields]
    index = tracemalloc.get_traced_memory()[0] / len(kept)
    tracemalloc.stop()
    return path.stat().st_size / FOLDER, parse, len(texts[0]) + 2.0, index


def _tensors(value: Any) -> list[Any]:
    """Return all tensors of a value, its values' included."""
    fields = [getattr(value, field.name) for field in dataclasses.fields(value)]
    inner = [x for field in fields if dataclasses.is_dataclass(field) for x in _tensors(field)]
    return [x for x in fields if hasattr(x, "numel")] + inner


def _clocked(
    function: Callable[..., Any], spent: dict[str, float], name: str, count: bool = False
) -> Callable[..., Any]:
    """Return a function that also adds its processor's time to `spent`, or its calls."""

    def call(*given: Any) -> Any:
        began = time.process_time()
        try:
            return function(*given)
        finally:
            spent[name] += 1.0 if count else time.process_time() - began

    return call
