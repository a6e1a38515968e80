"""The card of a data set: what it is, from what, how many; for programs as JSON, for people as Markdown."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from torchgrasp.data.shards import JobRow
from torchgrasp.errors import Status

FIELDS = (
    ("points", "p x 3", "cloud of each job, one behind the other [m]"),
    ("viewpoints", "j x 3", "position of the camera [m]; zeros: unknown"),
    ("grasps.joints, grasps.pregrasp", "g x h", "actuated joints, closed and opened [rad]"),
    ("grasps.obj_from_hand", "g x 4 x 4", "pose of the hand's base link in the object's frame [m]"),
    ("grasps.approach", "g x 3", "direction of the straight path to the pre-grasp"),
    ("grasps.contacts.points, .normals", "g x f x 3", "planned contacts and outward normals"),
    ("grasps.contacts.std_m", "g x f", "standard deviation of the surface at the contact [m]"),
    ("grasps.contacts.variance", "g x f", "the same in the normalised units of the shape"),
    ("grasps.certificate.margin, .closed", "g", "how far from losing form closure, and whether it has it"),
    ("grasps.certificate.witness", "g x 6", "the wrench that is hardest to resist"),
    ("grasps.certificate.rank_ratio, .residual", "g", "how well the certificate itself is conditioned"),
    ("grasps.clearance, .tip_error, .normal_angle", "g, g x f, g x f", "distances [m] and angles [rad] of the plan"),
    ("grasps.permutation", "g x f", "contact of each finger in the plan"),
    ("grasps.score", "g", "log-odds of the predicted success"),
    ("grasps.status", "g", "0: executable; all are"),
    ("passed, outcome", "g x d", "verdict of each try in the simulator, and its Status"),
)
"""Tensors of a shard: name, shape and meaning."""


def card_of(asked: dict[str, Any], campaign: str, rows: Sequence[JobRow], digests: Sequence[str]) -> dict[str, Any]:
    """Return the content of `card.json`.

    Args:
        asked: content of `campaign.json`.
        campaign: its SHA-256, which each shard names.
        rows: of all jobs.
        digests: SHA-256 of each shard.
    """
    tries = asked["protocol"]["noise"]["draws"]
    counts = {
        "jobs": len(rows),
        "status": dict(Counter(row.status.name for row in rows).most_common()),
        "objects": len({row.object for row in rows}),
        "families": len({row.family or row.object for row in rows}),
        "groups": dict(sorted(Counter(row.group for row in rows if row.group).items())),
        "points": sum(row.points for row in rows),
        "grasps": sum(row.grasps for row in rows),
        "tries": tries * sum(row.grasps for row in rows),
        "passed": sum(row.passed for row in rows),
    }
    jobs = [{name: x for name, x in row.as_json().items() if name != "meta"} for row in rows]
    return {
        "torchgrasp": "grasp-shards",
        "version": 1,
        "licence": asked["licence"],
        "campaign": campaign,
        "jobs_in_shard": asked["jobs_in_shard"],
        "asked": asked,
        "counts": counts,
        "shards_sha256": list(digests),
        "jobs": jobs,
    }


def describe(card: dict[str, Any]) -> str:
    """Return the card in Markdown, with the header that hubs of data sets read."""
    asked, counts = card["asked"], card["counts"]
    hand, protocol, trials = asked["hand"], asked["protocol"], asked["trials"]
    reasons = "\n".join(f"| {name.lower()} | {n} | {Status[name].sentence} |" for name, n in counts["status"].items())
    fields = "\n".join(f"| {name} | {shape} | {meaning} |" for name, shape, meaning in FIELDS)
    versions = ", ".join(f"{name} {version}" for name, version in asked["versions"].items() if version != "none")
    share = f"{counts['passed']} of {counts['tries']} tries passed" if counts["tries"] else "nothing was tried"
    tags = "tags: [robotics, dexterous-grasping]"
    return f"""---
license: {_quoted(card["licence"])}
{tags}
---
# Grasps of the {hand["name"]} hand, tried under "{protocol["name"]}"

Grasps that torchgrasp planned on partial point clouds, each with its certificate of frictional form closure, the
standard deviation of the surface at its contacts, its predicted success, and its success in simulation.

* {counts["jobs"]} jobs, one for each view of {counts["objects"]} objects of {counts["families"]} families
* {counts["grasps"]} grasps; {share}
* licence: {card["licence"]}
* hand: {hand["name"]}, fingers {hand["finger_names"]}, SHA-256 {hand["sha256"]}
* grasps of a view: {trials["grasps"]} at most ({trials["ranks"]}), of {trials["starts"]} starts, seed {trials["seed"]}
* simulator: {protocol["trial"]["simulator"]}, friction {protocol["trial"]["friction"]:g}
* made with {versions}

| status of a job | jobs | meaning |
| --- | --- | --- |
{reasons}

## Reading

```python
from torchgrasp.data import read_shards

data = read_shards(".", points=512)  # for a torch DataLoader: each item is a dict of one grasp
first = data.job(0)  # or job by job: row, cloud, grasps, passed, outcome
```

`card.json` has a row for each job, and all that was asked. `shard-NNNNNN.safetensors` holds {card["jobs_in_shard"]}
jobs, one behind the other; its metadata says how many points and grasps are each job's. Lengths are metres, angles
radians, in the frame of the object.

| tensor | shape | meaning |
| --- | --- | --- |
{fields}

p points, j jobs, g grasps, d tries of a grasp, h joints ({hand["joint_names"]}), f fingers.
"""


def _quoted(text: str) -> str:
    """Return a text for a header in YAML."""
    return text.lower() if text.replace("-", "").replace(".", "").isalnum() else '"' + text.replace('"', "'") + '"'
