"""Fit how likely hidden places are full, and show the reliability on families of objects left out.

Upright objects are scattered on a table and rendered. Of every other family are the objects that
the model is fitted to; the others judge it. Places are drawn where the camera cannot see, and the
meshes tell which are full.
"""

from pathlib import Path

import numpy as np
import torch
import trimesh
import tyro
from benchmarks.scene.scenes import scatter
from sklearn.linear_model import LogisticRegression

from torchgrasp import Scene
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.cloud.depth import cloud_from_depth
from torchgrasp.data import read_entry, read_object_mesh
from torchgrasp.data.manifest import read_entries
from torchgrasp.files import format_json, write_file
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.geometry.frames import inverse
from torchgrasp.geometry.plane import Plane, upright_frame
from torchgrasp.scene.image import DepthImage
from torchgrasp.scene.occupancy import (
    MODEL,
    OCCUPANCY,
    cast_shadows,
    load_occupancy_model,
    probability,
    shadow_features,
)

KNOTS = {
    "thing": (
        (0.0, 0.1, 0.25, 0.5, 0.8, 1.2),
        (-0.02, -0.005, 0.0, 0.005, 0.03),
        (-0.03, -0.008, -0.002, 0.002, 0.01, 0.03),
        (-0.03, -0.008, -0.002, 0.002, 0.01, 0.03),
        (-0.1, 0.2, 0.6, 1.0, 1.4),
        (0.3, 0.45, 0.55, 0.8),
    ),
    "target": ((0.0, 0.02, 0.05, 0.1, 0.2), (0.0, 0.03, 0.06, 0.1, 0.15)),
    "unseen": ((0.0, 0.03, 0.06, 0.1, 0.15),),
}
"""Knots of the piecewise linear functions of each kind's features: lengths in metres, depths over
sizes.
"""
PLACES = 60_000
KEPT = 1500
"""Places drawn around a target, and hidden ones of each kind that are kept."""
SEEN = 400
"""Least number of pixels of a target."""
DAMPING = 3.0
"""Weight of the squares of the values in the regression."""
BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)
"""Bins of the reliability."""


def make_scene(
    meshes: dict[str, trimesh.Trimesh], seed: int
) -> tuple[Scene, list[trimesh.Trimesh]]:
    """Return (scene, meshes): a rendered scene of 5 to 8 objects, and the objects' true meshes [m].

    Both are in the scene's upright frame. The target is the object nearest to the middle that the
    camera sees well.
    """
    rng = np.random.default_rng(seed)
    generator = torch.Generator().manual_seed(seed)
    names = rng.choice(sorted(meshes), int(rng.integers(5, 9)), replace=False)
    things = [meshes[name].copy() for name in names]
    radius = float(rng.uniform(0.18, 0.26))
    gap = float(rng.uniform(0.005, 0.03))
    poses = None
    while poses is None:
        try:
            poses = scatter(things, generator, radius, gap)
        except BadArgument:  # the circle is too small for them
            radius += 0.02
    for mesh, pose in zip(things, poses, strict=True):
        mesh.apply_transform(pose.numpy())
    camera = look_at(rng.uniform(0, 360), rng.uniform(30, 60), rng.uniform(0.45, 0.8))
    depth, labels = render_depth(things, camera, seed=seed)
    pixels = torch.nonzero(depth > 0)
    seen = labels[pixels[:, 0], pixels[:, 1]]
    points = cloud_from_depth(depth, INTRINSICS, camera_pose=camera).points
    order = np.argsort([np.linalg.norm(mesh.bounds.mean(0)[:2]) for mesh in things])
    target = next(int(i) + 1 for i in order if int((seen == i + 1).sum()) > SEEN)
    image = DepthImage(depth, INTRINSICS, camera)
    scene = Scene(points, seen, image, pixels, Plane.horizontal(0.0), target)
    cloud = scene.cloud()
    frame = upright_frame(cloud.points, cloud.viewpoint, scene.table)
    for mesh in things:
        mesh.apply_transform(inverse(frame).numpy())
    return scene.to_upright(frame), things


def collect(
    meshes: dict[str, trimesh.Trimesh], seeds: range
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return (features, full) of hidden places in rendered scenes, by the kind of place.

    `features` are (n, k), and `full` (n,) tells whether an object other than the target is there.
    The kinds are "unseen", behind the "target", and behind another "thing". Each seed gives a
    scene.
    """
    found: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {kind: [] for kind in KNOTS}
    for seed in seeds:
        scene, things = make_scene(meshes, seed)
        assert scene.target is not None
        others = [mesh for k, mesh in enumerate(things, start=1) if k != scene.target]
        shadows = cast_shadows(scene, scene.target)
        rng = np.random.default_rng(seed)
        own = scene.points[scene.rows_of()]
        tops = scene.points[scene.labels > 0][:, 2]
        low = own.amin(0).numpy() - OCCUPANCY.sideways
        high = own.amax(0).numpy() + OCCUPANCY.sideways
        low[2] = 0.0
        high[2] = float(tops.max()) + OCCUPANCY.above
        places = torch.from_numpy(rng.uniform(low, high, (PLACES, 3)))
        behind, owner = shadows.look(places)
        hidden = (owner == -1) | ((owner != 0) & (behind > -OCCUPANCY.noise))
        kinds = {"unseen": owner == -1, "target": owner == scene.target}
        kinds["thing"] = ~kinds["unseen"] & ~kinds["target"]
        for kind, rows in kinds.items():
            rows = torch.nonzero(rows & hidden)[:KEPT, 0]
            for thing in owner[rows].unique().tolist():
                some = rows[owner[rows] == thing]
                if kind == "unseen":
                    features = places[some, 2:]
                elif kind == "target":
                    features = torch.stack([behind[some], places[some, 2]], -1)
                else:
                    features = shadow_features(shadows, thing, places[some])
                inside = [mesh.contains(places[some].numpy()) for mesh in others]
                found[kind].append((features.numpy(), np.any(inside, 0)))
    return {
        kind: (np.concatenate([x for x, _ in parts]), np.concatenate([x for _, x in parts]))
        for kind, parts in found.items()
    }


def fit(
    features: np.ndarray, full: np.ndarray, knots: tuple[tuple[float, ...], ...]
) -> dict[str, object]:
    """Fit the probability that a place is full by logistic regression; return its parameters.

    The log-odds are a bias plus a piecewise linear function of each feature. "knots" and "values"
    give these functions. `features` are (n, k) and `full` is a mask (n,).
    """
    hats = [
        np.stack([np.interp(x, k, e) for e in np.eye(len(k))], 1)
        for x, k in zip(features.T, knots, strict=True)
    ]
    regression = LogisticRegression(C=1 / DAMPING, solver="newton-cholesky", tol=1e-9)
    fitted = regression.fit(np.concatenate(hats, 1), full)
    weights = np.round(fitted.coef_[0], 3)
    split = np.split(weights, np.cumsum([len(k) for k in knots])[:-1])
    values = [v.tolist() for v in split]
    return {"bias": round(float(fitted.intercept_[0]), 3), "knots": knots, "values": values}


def reliability(p: np.ndarray, full: np.ndarray) -> list[str]:
    """Return a line of text for each bin of probabilities: number, mean and observed share.

    `p` (n,) are the predicted probabilities, and `full` (n,) tells which places are full.
    """
    which = np.digitize(p, BINS[1:-1])
    rows = [(BINS[i], BINS[i + 1], which == i) for i in range(len(BINS) - 1)]
    return [
        f"{a:.2f}-{b:.2f} {r.sum():7d} {p[r].mean():.3f} {full[r].mean():.3f}"
        for a, b, r in rows
        if r.any()
    ]


def occupancy(objects: tyro.conf.Positional[Path], scenes: int = 30, model: Path = MODEL) -> None:
    """Fit the model of occupancy to rendered scenes, judge it on families left out, and write it.

    Args:
        objects: folder of objects with a manifest that tells their families.
        scenes: of either half.
        model: file of the model.
    """
    torch.set_num_threads(1)
    family = {name: read_entry(objects, name).family for name in read_entries(objects)}
    families = sorted(set(family.values()))
    halves: tuple[dict[str, trimesh.Trimesh], ...] = ({}, {})
    for name in family:
        halves[families.index(family[name]) % 2][name] = read_object_mesh(objects, name)
    seen = collect(halves[0], range(scenes))
    unseen = collect(halves[1], range(1000, 1000 + scenes))
    content = {kind: fit(*seen[kind], KNOTS[kind]) for kind in KNOTS}
    note = f"{scenes} rendered scenes of 5 to 8 objects of {len(families) // 2} families"
    write_file(model, format_json({**content, "fitted_on": note}) + "\n")
    load_occupancy_model.cache_clear()
    for kind, (features, full) in unseen.items():
        p = probability(kind, torch.from_numpy(features)).numpy()
        brier = np.mean((p - full) ** 2)
        print(f"{kind}: {full.mean():.3f} full, Brier {brier:.4f} of {full.var():.4f}")
        print(*reliability(p, full), sep="\n", flush=True)
