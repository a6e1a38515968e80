"""Samples of a hand on disk: a folder of chunks that survives a kill and is the same whoever wrote it.

`samples.json` says what the folder holds; `chunk-000000.safetensors` and so on are 10^4 postures each. A chunk is
written beside its place and moved there whole, and comes from (seed, chunk) alone: so a run that was killed is
continued by the same command, and the finished folder has the same bytes for any number of workers.
"""

import dataclasses
import json
import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from torchgrasp.base import join
from torchgrasp.errors import BadArgument, ModelFileError, OutputError
from torchgrasp.files import LOCK, hold_folder, load_tensors, save_tensors, write_file
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.sample import (
    CHUNK,
    MAX_SAMPLES,
    HandSamples,
    Sampling,
    check_sampling,
    chunk_counts,
    draw_chunk,
)

MANIFEST = "samples.json"
MAX_MANIFEST = 1024 * 1024
TEXTS = ("hand", "fingers", "hand_sha256", "hand_codes", "seed", "sampling")


@dataclasses.dataclass(frozen=True)
class SampleFolder:
    """A complete folder of samples: `n` postures of the joints `joint_names` in chunks that are read when asked for.

    `meta` tells the hand, its finger option and its files' hash, the seed and the way of sampling.
    """

    folder: Path
    n: int
    joint_names: tuple[str, ...]
    meta: dict[str, str]

    def __len__(self) -> int:
        """Count the postures."""
        return self.n

    def __iter__(self) -> Iterator[HandSamples]:
        """Read one chunk after another."""
        return (self.chunk(i) for i in range(len(chunk_counts(self.n))))

    def chunk(self, i: int) -> HandSamples:
        """Read chunk i.

        Raises:
            ModelFileError: it is missing, damaged, or another's.
        """
        path, count = _chunk_path(self.folder, i), chunk_counts(self.n)[i]
        tensors, meta = load_tensors(path, "samples", {"joints", "q"})
        shapes = tuple(tuple(tensors[name].shape) for name in ("joints", "q"))
        wanted = (count, len(self.joint_names)), (count, 6)
        if shapes != wanted:
            raise ModelFileError("path", f"{path}: tensors of shapes {shapes}", f"shapes {wanted}")
        if {key: meta.get(key) for key in self.meta} != self.meta or meta.get("chunk") != str(i):
            raise ModelFileError("path", f"{path}: the chunk of other samples", f"chunk {i} of {self.meta}")
        return HandSamples(tensors["joints"], tensors["q"], self.joint_names, dict(self.meta))

    def read(self, n: int | None = None) -> HandSamples:
        """Read the first `n` postures into memory; by default all.

        Raises:
            BadArgument: n outside [1, len].
            ModelFileError: a chunk is missing or damaged.
        """
        n = self.n if n is None else n
        if not 1 <= n <= self.n:
            raise BadArgument("n", n, f"a whole number in [1, {self.n}]")
        return join([self.chunk(i) for i in range(len(chunk_counts(n)))])[:n]


def write_samples(
    hand: Hand,
    n: int,
    folder: Path | str,
    seed: int = 0,
    workers: int = 1,
    sampling: Sampling = "uniform",
    progress: bool = False,
) -> SampleFolder:
    """Write the samples that `sample_configurations` returns, chunk by chunk, and return the folder.

    The same call continues a run that was ended by whatever means; no more than one chunk for each worker is lost.

    Args:
        hand: the hand.
        n: how many free postures, at most 10^8.
        folder: is made if it is not there; it must be empty, or hold the beginning of the same samples.
        seed: of the draws.
        workers: threads that draw at the same time.
        sampling: "uniform" or "opposed", see `sample_configurations`.
        progress: show a bar where there is a terminal.

    Raises:
        BadArgument: a number outside its range, or a hand of which hardly any posture is kept.
        OutputError: the folder holds other samples or is being written by another run, or the disk is full.
    """
    folder, meta = Path(folder), check_sampling(hand, n, seed, workers, sampling)
    counts = chunk_counts(n)
    made = SampleFolder(folder, n, hand.joint_names, meta)
    content = {"torchgrasp": "samples", "version": 1, "n": n, "chunk": CHUNK, "joint_names": hand.joint_names, **meta}
    with hold_folder(folder):
        _start(folder, json.dumps(content, indent=1) + "\n")
        missing = [i for i in range(len(counts)) if not _is_whole(made, i)]
        needed = 8 * sum(counts[i] for i in missing) * (hand.dof + 6)
        if shutil.disk_usage(folder).free < needed:
            raise OutputError("folder", f"{folder}, {shutil.disk_usage(folder).free} bytes free", f"{needed} bytes")

        def write(i: int) -> None:
            joints, q, drawn = draw_chunk(hand, seed, i, counts[i], sampling)
            told = {**meta, "chunk": str(i), "drawn": str(drawn)}
            save_tensors(_chunk_path(folder, i), "samples", {"joints": joints, "q": q}, told)

        pool = ThreadPoolExecutor(workers)
        try:
            for _ in _shown(pool.map(write, missing), len(missing), progress):
                pass
        finally:  # on an error or an interrupt the chunks under way are finished, the others never begun
            pool.shutdown(wait=True, cancel_futures=True)
    return made


def load_samples(folder: Path | str) -> SampleFolder:
    """Open a complete folder of samples; chunks are read when they are asked for.

    Raises:
        ModelFileError: it is no such folder, is not finished, or its manifest is damaged.

    >>> import tempfile
    >>> from torchgrasp.hand.load import load_hand
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = write_samples(load_hand("barrett"), 100, folder)
    ...     load_samples(folder).read(50).joints.shape
    torch.Size([50, 4])
    """
    folder = Path(folder)
    found = _manifest(folder)
    names: Any = found.get("joint_names")
    n: Any = found.get("n")
    texts: dict[str, Any] = {key: found.get(key) for key in TEXTS}
    sound = isinstance(names, list) and 0 < len(names) <= 1000 and all(isinstance(x, str) for x in names)
    sound = sound and isinstance(n, int) and not isinstance(n, bool) and 1 <= n <= MAX_SAMPLES
    if not (sound and found.get("chunk") == CHUNK and all(isinstance(x, str) for x in texts.values())):
        raise ModelFileError("folder", f"{folder / MANIFEST}, which is damaged", "a manifest written by write_samples")
    made = SampleFolder(folder, n, tuple(names), texts)
    gaps = [i for i in range(len(chunk_counts(n))) if not _chunk_path(folder, i).is_file()]
    if gaps:
        lacking = f"{folder} without {len(gaps)} of {len(chunk_counts(n))} chunks"
        raise ModelFileError("folder", lacking, "a finished folder: run the command that began it again")
    return made


def _chunk_path(folder: Path, i: int) -> Path:
    """Return where chunk i lies."""
    return folder / f"chunk-{i:06d}.safetensors"


def _is_whole(made: SampleFolder, i: int) -> bool:
    """Tell whether a chunk is there and sound; a damaged one is drawn again."""
    try:
        made.chunk(i)
    except ModelFileError:
        return False
    return True


def _manifest(folder: Path) -> dict[str, Any]:
    """Read a folder's manifest."""
    path = folder / MANIFEST
    allowed = "a folder written by write_samples"
    if not path.is_file():
        raise ModelFileError("folder", f"{folder} without {MANIFEST}", allowed)
    try:
        if path.stat().st_size > MAX_MANIFEST:
            raise ValueError("larger than 1 MiB")
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ModelFileError("folder", f"{path}: {error}", allowed) from error
    if not isinstance(found, dict) or found.get("torchgrasp") != "samples" or found.get("version") != 1:
        raise ModelFileError("folder", f"{path}: another kind of file, or of another version", allowed)
    return found


def _start(folder: Path, manifest: str) -> None:
    """Write the manifest, or check that it is the same, and drop what a killed run left half-written."""
    path = folder / MANIFEST
    if path.exists():
        if path.read_text("utf-8", errors="replace") != manifest:
            raise OutputError("folder", f"{folder}, which holds other samples", "an empty folder, or the same samples")
    elif any(x.name != LOCK for x in folder.iterdir()):
        raise OutputError("folder", f"{folder}, which holds other files", "an empty folder")
    else:
        write_file(path, manifest)
    for half in folder.glob(".*.safetensors"):
        half.unlink()


def _shown(steps: Iterator[None], allreduce: int, progress: bool) -> Iterator[None]:
    """Show a bar over steps where there is a terminal and it is asked for."""
    if not progress:
        return steps
    from tqdm import tqdm

    return iter(tqdm(steps, allreduce=allreduce, unit="chunk", disable=None, leave=False))
