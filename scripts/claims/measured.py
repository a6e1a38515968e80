"""Figures that are measured again."""

import functools
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
import trimesh
from benchmarks.common import timed
from paper.deviations import of_closings, of_equations, of_shapes
from paper.table3 import sample_whole

from claims.table import ROOT, Finding, claim
from torchgrasp import (
    ContactSpec,
    Scene,
    explain_empty,
    fit_shape,
    load_hand,
    load_object,
    load_scene,
    plan_grasps,
)
from torchgrasp.cloud.camera import INTRINSICS, look_at, render_depth
from torchgrasp.data.shipped import DATA
from torchgrasp.hand.load import find_hand

HANDS = "docs/hands.md"
CAMERA = "docs/real_camera.md"
SPEED = "docs/results/speed.md"
PAPER = "docs/results/paper.md"
TABLE = ContactSpec(table=0.0)
FOLDER = tempfile.TemporaryDirectory(prefix="claims")  # deleted at the end
WORK = Path(FOLDER.name)


def call(*words: str | Path) -> str:
    """Run torchgrasp in `WORK`, and return what it prints; an exit code of 2 or more is an error."""
    done = subprocess.run(
        [sys.executable, "-m", "torchgrasp", *map(str, words)],
        cwd=WORK,
        capture_output=True,
        text=True,
    )
    if done.returncode > 1:
        raise RuntimeError(done.stderr.strip())
    return done.stdout


@functools.cache
def draft() -> str:
    """Draft the LEAP hand again, and return what is printed."""
    (WORK / "leap.urdf").write_bytes((find_hand("leap") / "hand.urdf").read_bytes())
    return call("hand", "new", "leap.urdf", "--out", "mine")


@claim(HANDS, "index_tip 10.5 mm", "is 10.5 mm your tip's radius?")
def leap_tip() -> Finding:
    """Read the radius of the first fingertip."""
    (found,) = re.findall(r"index_tip [\d.]+ mm", draft())
    return found, found == "index_tip 10.5 mm"


@claim(
    HANDS,
    "57.9% of 5000 random postures",
    "cylinder: 100 of 100 grasps",
    "cylinder: 66 of 99 grasps",
)
def leap_check() -> Finding:
    """Check the drafted hand; other processors round differently, so counts may differ by three."""
    draft()
    said = call("hand", "check", "mine", "--out", "mine/hand.png")
    (share,) = map(float, re.findall(r"([\d.]+)% of 5000 random postures collide", said))
    counts = [int(x) for x in re.findall(r"cylinder: (\d+) of \d+ grasps", said)]
    held = len(counts) == 2 and abs(counts[0] - 100) <= 3 and abs(counts[1] - 66) <= 3
    return f"{share} %; {counts} grasps executable", held and abs(share - 57.9) < 0.5


@claim(
    HANDS,
    "held the cylinder: lifted 0.10 m, moved 3 mm and 6 deg in the hand",
    "to a held object in about ten minutes",
)
def leap_holds() -> Finding:
    """Correct the draft as the guide does, plan, and close in the simulator; 1 mm or 1 degree more
    is as good.
    """
    draft()
    hand = WORK / "mine" / "hand.toml"
    began = time.perf_counter()
    parked = 'parked = { "5" = -0.3, "4" = 0.0, "6" = -0.2, "7" = -0.3 }'
    text = re.sub(r"(?m)^parked = .*", parked, hand.read_text("utf-8"))
    hand.write_text(
        re.sub(r"(?m)^kd = .*", "kd = 0.1", re.sub(r"(?m)^kp = .*", "kp = 3.0", text)), "utf-8"
    )
    cylinder = DATA / "cylinder"
    words = (
        "--hand",
        "mine",
        "--out",
        "out",
        "--starts",
        "200",
        "--mesh",
        cylinder / "mesh.ply",
        "--close",
    )
    last = call("grasp", cylinder / "view.ply", *words).strip().splitlines()[-1]
    match = re.search(r"held the cylinder: lifted 0.10 m, moved (\d+) mm and (\d+) deg", last)
    took = time.perf_counter() - began
    return f"{last} ({took:.0f} s)", match is not None and int(match[1]) <= 4 and int(
        match[2]
    ) <= 3 and took < 300


@claim("docs/planning.md", "contacts: 0 of 20 starts (20 not_closed)")
def no_friction() -> Finding:
    """Plan without friction."""
    spec = ContactSpec(friction=0.0, table=0.0)
    found = str(
        explain_empty(load_object("cylinder").view, load_hand("barrett"), spec, starts=20).funnel
    ).strip()
    return found, found == "contacts: 0 of 20 starts (20 not_closed)"


@claim("docs/scenes.md", "four objects, one depth image", "or scene.select(4), by label")
def shipped_scene() -> Finding:
    """Count the objects, and click the pixel of the page."""
    scene = load_scene()
    label = scene.select((394, 312)).target
    return f"{len(scene.things)} objects, label {label}", len(scene.things) == 4 and label == 4


@claim("docs/scenes.md", "A box 5 mm high is found and one 3 mm high is not.")
def low_boxes() -> Finding:
    """Render boxes of both heights beside a higher one, with the noise of three cameras."""
    camera = look_at(20.0, 45.0, 0.7)
    counts = list[int]()
    for height in (0.003, 0.005):
        low = trimesh.creation.box([0.1, 0.08, height])
        high = trimesh.creation.box([0.05, 0.05, 0.06])
        low.apply_translation([0.0, 0.0, height / 2])
        high.apply_translation([0.0, 0.15, 0.03])
        for noise in (True, "realsense", "zivid"):
            depth, _ = render_depth([low, high], camera, noise=noise)
            counts.append(len(Scene.from_depth(depth, INTRINSICS, camera).things))
    return f"{counts[:3]} objects with 3 mm, {counts[3:]} with 5 mm", counts == [1, 1, 1, 2, 2, 2]


@claim("docs/faq.md", "`--starts 200` is enough for compact objects")
@claim("docs/speed.md", "`starts=200` is enough for compact objects")
def few_starts() -> Finding:
    """Compare the best predicted success of 200 and 1000 starts on three compact objects: it may
    lose 2 points.
    """
    hand = load_hand("allegro")
    lost = dict[str, float]()
    for name in ("cylinder", "jug", "rabbit"):
        few, many = (
            plan_grasps(load_object(name).view, hand, TABLE, starts=n).success[0]
            for n in (200, 1000)
        )
        lost[name] = float(many - few)
    return ", ".join(f"{name} {100 * x:.1f} points less" for name, x in lost.items()), max(
        lost.values()
    ) <= 0.02


@claim(CAMERA, "in two minutes")
def one_frame() -> Finding:
    """Run the page's first three steps: render the frame, find the scene, grasp."""
    code = re.findall(r"```python\n(.*?)```", (ROOT / CAMERA).read_text("utf-8"), re.DOTALL)[0]
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], cwd=WORK, check=True)
    call("cloud", "scene", "frame.npy", "--intrinsics", "k.txt", "--out", "scene.npz")
    call("grasp", "scene.npz", "--hand", "barrett", "--starts", "20", "--out", "out/frame")
    took = time.perf_counter() - began
    return f"{took:.0f} s", took < 120


@claim(PAPER, "100, 83, 59 and 55 points of 1000")
def paper_filter() -> Finding:
    """Run the paper's filter on whole clouds; other processors round differently, so counts may
    differ by two.
    """
    clouds = [
        sample_whole(load_object(name).mesh, 0) for name in ("cylinder", "jug", "rabbit", "spray")
    ]
    counts = [len(fit_shape(cloud, budget="sure", support="paper", seed=0).x) for cloud in clouds]
    return f"{counts}", all(abs(x - y) <= 2 for x, y in zip(counts, (100, 83, 59, 55), strict=True))


WRITTEN = {
    "K + sigma^2 I is indefinite in 100 of 100 clouds": "100 of 100 clouds",
    "in 43 of 100; `fit_shape(psi_scale=1)` raises for 33": "43 of 100 clouds; `psi_scale=1` raises for 33",
    "asymmetry 0.83 of the largest entry": "asymmetry 0.83 of the largest entry",
    "f_w is 0.02 to 13.4 long at the clouds' points, 90 % within 0.59 to 3.5": "0.02 to 13.4, 90 % within 0.59 to 3.5",
    "the farthest point is at 1.32 to 1.65": "1.32 to 1.65",
    "margin 0.031": "margin 0.031",
    "lambda is 0.00 to 0.80 as printed, 0.61 to 0.76 under": "0.00 to 0.80 as printed, 0.61 to 0.76 with",
}
"""Texts of the page on the paper's equations, and what the measurement prints where they hold."""


@functools.cache
def as_written() -> str:
    """Measure where the paper's equations fail as written."""
    found = *of_equations(), *of_closings(), *of_shapes(25)
    return "; ".join(f"{name}: {value}" for name, value in found)


for text, printed in WRITTEN.items():
    claim(PAPER, text)(
        lambda printed=printed: (
            (printed, True) if printed in as_written() else (as_written(), False)
        )
    )


@claim(SPEED, "half of torch's own")
def import_time() -> Finding:
    """Time the imports of torch and of torchgrasp in new processes, and compare the least of three."""
    code = "import time; a = time.process_time(); import {}; print(time.process_time() - a)"
    own, both = (
        min(
            float(subprocess.check_output([sys.executable, "-c", code.format(name)], text=True))
            for _ in range(3)
        )
        for name in ("torch", "torchgrasp")
    )
    return f"{both - own:.2f} s beyond {own:.2f} s of torch", 0.3 < both / own - 1 < 0.7


@claim(SPEED, "| first executable grasp, cloud to answer | median 0.6 s, worst 1.2 s |")
def first_grasp() -> Finding:
    """Time the first batch on the four shipped objects by the processor's clock; loaded machines
    may take 1.5 times.
    """
    hand = load_hand("allegro")
    took = list[float]()
    for name in ("cylinder", "cylinder", "jug", "rabbit", "spray"):
        grasps, seconds = timed(
            lambda name=name: plan_grasps(load_object(name).view, hand, TABLE, time_budget=1e-3)
        )
        took.append(seconds if int((grasps.status == 0).sum()) else torch.inf)
    median = sorted(took[1:])[2]
    worst = max(took[1:])
    return (
        f"median {median:.2f} s, worst {worst:.2f} s, at most 1.5 times",
        median < 0.9 and worst < 1.8,
    )
