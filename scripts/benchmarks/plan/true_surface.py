"""What certificates on the estimated surface are worth on the true one, by specification; the mesh
only judges.
"""

import dataclasses
from typing import Any

from torch import Tensor
from tqdm import tqdm

from benchmarks.common import Options, Row, bench
from benchmarks.ground_truth import nearest_on_mesh, read_views
from torchgrasp import ContactSpec, Status, fit_shape, plan_contacts
from torchgrasp.contacts.form_closure import closed_exact
from torchgrasp.shape.gp import ShapeGP
from torchgrasp.values.planning import Contacts

FRICTION = 0.6
"""With which certified contacts must be closed on the true surface."""

DEFAULT = ContactSpec(table=0.0)

CHANGED = {
    "friction_margin 1": dataclasses.replace(DEFAULT, friction_margin=1.0),
    "friction_margin 0.75": dataclasses.replace(DEFAULT, friction_margin=0.75),
    "friction_margin 0.375": dataclasses.replace(DEFAULT, friction_margin=0.375),
    "separation 0": dataclasses.replace(DEFAULT, separation=0.0),
    "separation 0.04": dataclasses.replace(DEFAULT, separation=0.04),
    "flatness None": dataclasses.replace(DEFAULT, flatness=None),
    "flatness 0.3": dataclasses.replace(DEFAULT, flatness=0.3),
    "table None": dataclasses.replace(DEFAULT, table=None),
    "tip_radius 0": dataclasses.replace(DEFAULT, tip_radius=0.0),
    "max_variance 0.1": dataclasses.replace(DEFAULT, max_variance=0.1),
    "max_variance 0.01": dataclasses.replace(DEFAULT, max_variance=0.01),
}


@bench("plan/truth", objects=True)
def truth(o: Options) -> list[Row]:
    """Compare the default specification and shape with the paper's, on every view."""
    views = list(read_views(o.objects[0], views=o.views))
    starts = o.starts
    seed = o.seed
    held: dict[str, dict[str, float]] = {"default": {}, "paper": {}}
    okay: dict[str, list[float]] = {name: [] for name in held}
    for name, view, cloud, mesh in tqdm(views, desc="truth", disable=None, leave=False):
        for label, spec, shape in (
            ("default", DEFAULT, fit_shape(cloud, table=0.0)),
            ("paper", ContactSpec.paper(), fit_shape(cloud, support="paper")),
        ):
            share, survived = survive(shape, spec, mesh, starts, seed)
            okay[label].append(share)
            if survived is not None:
                held[label][f"{name}/{view}"] = survived
    mean = {label: sum(s.values()) / len(s) for label, s in held.items()}
    lowest = sorted(held["default"].items(), key=lambda item: item[1])[:4]
    done = {label: sum(values) / len(values) for label, values in okay.items()}
    row = Row(
        f"certified grasps closed on the true surface at friction {FRICTION}, {len(views)} views, mean over views",
        ">= 0.80 with the default specification",
        f"{mean['default']:.2f} (paper's specification on the paper's shape {mean['paper']:.2f}); least "
        f"{', '.join(f'{n} {s:.2f}' for n, s in lowest)}; certified {done['default']:.1%} of the starts "
        f"(paper {done['paper']:.1%})",
        mean["default"] >= 0.8,
        {"shares": held, "certified": okay},
    )
    return [row]


@bench("plan/fields", objects=True)
def fields(o: Options) -> list[Row]:
    """Change one field of the default specification at a time."""
    views = list(read_views(o.objects[0], views=o.views))
    starts = max(o.starts // 5, 1)
    seed = o.seed
    results: dict[str, list[tuple[float, float]]] = {
        "default": [],
        **{name: [] for name in CHANGED},
    }
    for _, _, cloud, mesh in tqdm(views, desc="fields", disable=None, leave=False):
        shape = fit_shape(cloud, table=0.0)
        for label, spec in {"default": DEFAULT, **CHANGED}.items():
            share, survived = survive(shape, spec, mesh, starts, seed)
            if survived is not None:
                results[label].append((share, survived))
    mean = {
        label: [sum(column) / len(column) for column in zip(*pairs, strict=True)]
        for label, pairs in results.items()
    }
    row = Row(
        f"one field of the specification changed: certified of the starts, and of these closed at friction {FRICTION}",
        "none",
        "; ".join(
            f"{label} {share:.0%} {survived:.3f}" for label, (share, survived) in mean.items()
        ),
        None,
        {"found": results},
    )
    return [row]


def survive(
    shape: ShapeGP, spec: ContactSpec, mesh: Any, starts: int, seed: int
) -> tuple[float, float | None]:
    """Return the share of starts that are certified, and of these the share closed where they touch
    the true surface.

    It is None where nothing is certified.
    """
    plan = plan_contacts(shape, spec, starts, seed)
    good = plan[plan.status == Status.OK].contacts
    return len(good) / starts, float(closed_on_mesh(good, mesh).double().mean()) if len(
        good
    ) else None


def closed_on_mesh(contacts: Contacts, mesh: Any) -> Tensor:
    """Tell which contacts are closed at the nearest points of the true surface, with its normals
    there.

    The nearest points are those on the fingers' side: on a wall thinner than the error the other
    side may be nearer.
    """
    points, facing = (part.flatten(0, 1).double() for part in (contacts.points, contacts.normals))
    points, normals = (x.view(contacts.points.shape) for x in nearest_on_mesh(mesh, points, facing))
    return closed_exact(points, normals, FRICTION)
