"""`torchgrasp grasp`: from a cloud to a held object; `torchgrasp objects` lists examples."""

import dataclasses
import importlib
import importlib.util
import math
import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from torchgrasp.app.cli.common import (
    AS_IT_IS,
    ViewOptions,
    check_folder,
    check_seed,
    describe_table,
    holding,
    judge_cloud,
    load_fingers,
    naming,
    print_notes,
    read_view,
    table_plane,
)
from torchgrasp.app.cli.progress import Progress
from torchgrasp.app.cli.results import write_results
from torchgrasp.app.cli.scene_grasps import Wanted, grasp_scene
from torchgrasp.app.report.page import GRASP_COLUMNS, grasp_rows
from torchgrasp.app.report.run import Run, verdict
from torchgrasp.base import check_number, check_whole
from torchgrasp.data.shipped import DATA, MASSES, list_objects, load_object
from torchgrasp.errors import BadArgument, MissingExtra, Status
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.files import format_columns, sha256
from torchgrasp.geometry.mesh import read_mesh
from torchgrasp.geometry.signed_distance import FIELD_SPACING, field_from_surface
from torchgrasp.hand.load import hand_of
from torchgrasp.planner.explain import explain_empty
from torchgrasp.planner.grasps import plan_grasps
from torchgrasp.scene.image import is_scene
from torchgrasp.shape.surface import extract_surface
from torchgrasp.specs import ContactSpec, Mode, Simulator, TrialSpec

if TYPE_CHECKING:
    import trimesh


def objects() -> int:
    """List the shipped objects, each with a noisy view and a true mesh."""
    for name in list_objects():
        print(f"{name} ({MASSES[name]:g} kg)\n  view: {DATA / name / 'view.ply'}\n  mesh: {DATA / name / 'mesh.ply'}")
    return 0


def grasp(
    cloud: Annotated[Positional[Path], arg(metavar="CLOUD")],
    /,
    hand: str,
    out: Path,
    mesh: Path | None = None,
    close: bool = False,
    seed: int = 0,
    starts: int = 1000,
    time_budget: float | None = None,
    view: Annotated[ViewOptions, arg(name="")] = AS_IT_IS,
    table: tuple[float, ...] | None = None,
    no_table: bool = False,
    friction: float = 0.8,
    fingers: str = "default",
    mode: Mode = "joint",
    label: int | None = None,
    point: tuple[float, float] | None = None,
    no_report: bool = False,
) -> int:
    """Plan grasps of the object in a partial cloud, and close on it in simulation; or of a thing in a scene.

    Writes grasps.safetensors, report.html and view.html, which turns, into the output folder. Where no grasp is
    executable, single changes are tried, and the one that helps most is named. The cloud is checked as by `cloud
    check`. Refused are: a camera below the table or that the points contradict, a plane left in, two bodies, and
    another unit. Other findings are printed as advice.

    Args:
        cloud: point cloud of one object (.ply, .pcd, .npy, .npz, .xyz, .txt, .csv), or a scene (.npz with depth and
            intrinsics; see docs/scenes.md).
        hand: name of a shipped hand, as allegro, barrett, leap or shadow, or the folder of another.
        out: folder of the results; it is made where it does not exist.
        mesh: true mesh of the object [m] in the frame of the cloud; only the simulator sees it.
        close: close the best grasp on the mesh, lift it and hold it (needs the extra "sim").
        seed: of every random draw; the same seed gives the same grasps.
        starts: random starts of the contact planner.
        time_budget: seconds for planning; the wave of starts that ends after them is the last. By default all starts.
        view: how the file of the cloud is meant.
        table: height of the table along the vertical, or four numbers nx ny nz d of the plane n . p = d, in metres; by
            default the table is at the lowest point of the cloud that is no outlier.
        no_table: there is no table.
        friction: coefficient of friction between fingertips and object.
        fingers: which grasp: an option of the hand, a number of fingers, or their names as in index,middle,thumb;
            "auto" tries the options, and takes the one whose best grasps are likeliest to succeed.
        mode: contacts, pose and joints together; contacts first and the learned model after; or the paper as written.
        label: of the thing to grasp in a scene; by default the easiest.
        point: column and row of a pixel on the thing to grasp in a scene.
        no_report: write the grasps alone, without the pages.
    """
    with naming(path="--out"):
        check_folder(out)
    if is_scene(cloud):
        if label is not None and point is not None:
            raise BadArgument("--point", "--label beside it", "one of the two")
        if mesh is not None or view != AS_IT_IS or table is not None or no_table or mode != "joint" or time_budget:
            found = "an option of clouds beside a scene"
            raise BadArgument(
                "CLOUD", found, "--label or --point, --hand, --fingers, --out, --seed, --starts, --friction"
            )
        the_hand, among = load_fingers(hand, fingers)
        with naming(friction="--friction"):
            spec = ContactSpec(friction=friction)
        check_whole("--starts", starts, 1, 1_000_000)
        check_seed(seed)
        wanted = Wanted(the_hand, spec, starts, seed, among)
        return grasp_scene(cloud, wanted, point if label is None else label, out, no_report)
    if label is not None or point is not None:
        raise BadArgument("--label, --point", f"{cloud}, which is no scene", "a .npz file with depth and intrinsics")
    if close:
        if mesh is None:
            raise BadArgument("--close", "no --mesh", "--close together with --mesh")
        import_simulator()
    check_whole("--starts", starts, 1, 1_000_000)
    check_seed(seed)
    if time_budget is not None:
        check_number("--time-budget", time_budget, 1e-3, math.inf)
    the_hand, among = load_fingers(hand, fingers)
    file = read_view("CLOUD", cloud, view)
    partial, plane = file.cloud, table_plane(file.cloud, view, table, no_table)
    with naming(mesh="--mesh", friction="--friction", table="--table"):
        true_mesh, parts = (None, None) if mesh is None else read_true_mesh(mesh)
        spec = (ContactSpec.paper if mode == "paper" else ContactSpec)(friction=friction, table=plane)
        trial = TrialSpec(friction=friction)
    print_notes(file.notes, judge_cloud("CLOUD", partial, view, plane))

    names = [
        *["fingers"] * (among is not None),
        "shape",
        "plan",
        "certify",
        "query",
        "refine",
        *["closing"] * close,
        "report",
    ]
    progress = Progress(*names)
    with progress.bar, holding("--out", out):
        origin = "no table" if plane is None else describe_table(plane)
        origin += " (lowest point)" * (plane is not None and table is None)
        camera = "camera known" if partial.viewpoint is not None else "camera estimated"
        progress.end("cloud", f"{len(partial)} points, {camera}, {origin}")
        grasps = plan_grasps(
            partial, the_hand, spec, starts, seed, fingers=among, mode=mode, observer=progress.end,
            time_budget=time_budget,
        )  # fmt: skip
        explanation = None
        if not bool((grasps.status == Status.OK).any()):
            options = {"fingers": among, "mode": mode, "observer": progress.end}
            explanation = explain_empty(partial, the_hand, spec, starts, seed, **options)
        the_hand = hand_of(grasps, the_hand)
        surface, plan = extract_surface(progress.values["shape"]), progress.values["plan"]
        name = object_name(cloud if mesh is None else mesh)
        stages = tuple(progress.stages)
        run = Run(name, cloud, partial, the_hand, spec, surface, grasps, stages, plan, explanation=explanation)
        if close and true_mesh is not None and len(run.executable):
            felt = field_from_surface(surface.vertices, surface.faces, FIELD_SPACING)
            closure = close_hand(run.executable[0], the_hand, true_mesh, trial, seed=seed, parts=parts, surface=felt)
            progress.end("closing", f"{closure.time[-1]:.1f} s simulated, {closure.status.name.lower()}")
            run = dataclasses.replace(run, stages=tuple(progress.stages), mesh=true_mesh, closure=closure)
        with naming(path="--out"):
            progress.end("report", write_results(out, run, no_report))
    if len(run.executable):
        print(f"\n{format_columns([GRASP_COLUMNS, *grasp_rows(run.executable, 5)])}\n")
    print(verdict(run))
    done = run.closure is not None and run.closure.held if close else len(run.executable) > 0
    return 0 if done else 1


def import_simulator(name: Simulator = "sapien") -> None:
    """Import a simulator; refuse one that cannot be loaded."""
    if importlib.util.find_spec(name) is None:
        raise MissingExtra(name, "sim" if name == "sapien" else name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a missing Vulkan does not concern physics
            importlib.import_module(name)
    except ImportError as error:
        allowed = "one whose libraries are there (Debian and Ubuntu: apt-get install libx11-6)"
        raise BadArgument("--close", f"a {name} that cannot be loaded ({error})", allowed) from error


def read_true_mesh(path: Path) -> "tuple[trimesh.Trimesh, list[trimesh.Trimesh] | None]":
    """Read a closed mesh, with the convex parts of a shipped object."""
    mesh, digest = read_mesh(path), sha256(path)
    for name in list_objects():
        if sha256(DATA / name / "mesh.ply") == digest:
            return mesh, load_object(name).parts
    return mesh, None


def object_name(path: Path) -> str:
    """Name an object by its file, or by its folder where files have the names of docs/data.md.

    >>> object_name(Path("objects/jug/view0_noisy.ply")), object_name(Path("mug.pcd")), object_name(Path("cloud.ply"))
    ('jug', 'mug', 'object in cloud.ply')
    """
    if re.fullmatch(r"(mesh|view\d*)(_noisy)?", path.stem):
        return path.resolve().parent.name or "object"
    return f"object in {path.name}" if path.stem in ("cloud", "model", "points", "scan") else path.stem
