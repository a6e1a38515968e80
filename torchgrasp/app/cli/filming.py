"""The command `torchgrasp film`, which closes the hand in simulation and writes a moving picture."""

from pathlib import Path
from typing import Annotated

from torchgrasp.app.cli.command import (
    Command,
    arguments,
    make_bar,
    naming,
    option,
    positional,
    required,
)
from torchgrasp.app.cli.inputs import SEED_HELP, check_folder, import_simulator
from torchgrasp.app.cli.results import PLANNED_HELP, load_planned, read_true_mesh, table_under
from torchgrasp.app.report.moving_picture import Rate, check_kind, write_film
from torchgrasp.evaluation.lift import close_hand
from torchgrasp.foundation.errors import BadArgument
from torchgrasp.foundation.rules import Range, Seed
from torchgrasp.hand.load import hand_of
from torchgrasp.values.specs import Simulator, TrialSpec


@arguments(path="out", closure="grasps", mesh="mesh")
class Film(Command):
    """Close a planned grasp in simulation, lift the object, and write it as a GIF or MP4.

    Without --mesh, the object is the estimated surface that `torchgrasp grasp` wrote beside the
    grasps. The exit code is 1 if the object was not held.
    """

    grasps: Path = positional(PLANNED_HELP)
    out: Path = required('file to write: .gif, or .mp4 (needs the extra "film", or ffmpeg)')
    hand: str | None = option(None, "name or folder of the hand; by default the name in the file")
    mesh: Path | None = option(
        None,
        "closed mesh of the object [m], in the frame of the grasps; by default the estimated "
        "surface.ply of GRASPS",
    )
    rank: Annotated[int, Range(1, 10**6)] = option(
        1, "rank of the executable grasp, as `torchgrasp grasp` prints it; 1 is the best"
    )
    simulator: Simulator = option("sapien", "simulator; each needs its extra: sim, or mujoco")
    mass: float = option(0.25, "mass of the object [kg]")
    friction: float = option(0.8, "coefficient of friction")
    rate: Rate = option(15, "pictures each second")
    seed: Seed = option(0, SEED_HELP)

    def run(self) -> int:
        """Simulate the closing and write the film; return the exit code."""
        with naming(path="--out"):
            check_kind(self.out)
        check_folder(self.out.parent)
        import_simulator(self.simulator)
        planned, surface = load_planned(self.grasps)
        good = planned.executable
        if self.rank > len(good):
            allowed = f"at most {len(good)}, the number of executable grasps"
            raise BadArgument("--rank", self.rank, allowed)
        mesh = surface if self.mesh is None else self.mesh
        if self.mesh is None and not mesh.is_file():
            raise BadArgument("--mesh", None, f"a mesh where {mesh} is missing")
        with naming(name_or_path="--hand"):
            hand = hand_of(good, self.hand)
        grasp = good[self.rank - 1]
        body, parts = read_true_mesh(mesh)
        table = table_under(body, grasp.table)
        spec = TrialSpec(mass=self.mass, friction=self.friction, simulator=self.simulator)
        closure = close_hand(grasp, hand, body, spec, seed=self.seed, parts=parts, table=table)
        with make_bar(None, "picture", desc="film") as bar:

            def show(done: int, every: int) -> None:
                bar.total = every
                bar.update()

            write_film(self.out, hand, grasp, closure, body, rate=self.rate, observer=show)
        ended = "held" if closure.held else f"not held: {closure.status.sentence}"
        print(f"{closure.time[-1]:.1f} s of the {hand.name} hand, the object {ended}: {self.out}")
        return 0 if closure.held else 1
