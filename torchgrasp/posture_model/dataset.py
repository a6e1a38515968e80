"""Sampled hand postures on disk: a folder of chunk files.

Each chunk is drawn from (seed, index of the chunk) and written atomically.
"""

import dataclasses
import json
import operator
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated

from torch import Tensor

from torchgrasp.files import (
    Field,
    Recent,
    begin_folder,
    hold_folder,
    load_tensors,
    read_json,
    save_tensors,
)
from torchgrasp.foundation.base import check_whole, join
from torchgrasp.foundation.checks import checked
from torchgrasp.foundation.errors import BadArgument, ModelFileError, OutputError
from torchgrasp.foundation.rules import Count, Range
from torchgrasp.hand.hand import Hand
from torchgrasp.posture_model.sample import (
    CHUNK_POSTURES,
    MAX_SAMPLES,
    HandSamples,
    SampleSpec,
    chunk_sizes,
    draw_chunk,
)

MANIFEST = "samples.json"  # file that describes the samples of a folder
KEPT = 128  # most chunks that stay in memory: those of a million postures, which take 200 MB
MANIFEST_BYTES = 2**20  # largest manifest
# the keys of `SampleSpec.meta`
META_KEYS = ("hand", "fingers", "hand_sha256", "hand_codes", "seed", "sampling")
Chunk = Annotated[int, Range(0, 1_000_000)]


@dataclasses.dataclass(frozen=True)
class SampleFolder:
    """A complete folder of `n` sampled postures of a hand, which are read on demand.

    `write_samples` makes it, and `load_samples` opens it. h counts the hand's actuated joints. The
    postures are in files of 10,000 (`CHUNK_POSTURES`), the chunks.

    Iteration yields the chunks as `HandSamples`. By index the folder is a map-style dataset for
    `torch.utils.data.DataLoader`: `folder[i]` is (joints (h,) [rad or m], contact code (6,)) of
    posture i. The code has three lengths [m], then three cosines (`encode`).

    Attributes:
        folder: path of the folder.
        n: number of postures.
        joint_names: names of the h joints, in the order of the hand.
        meta: texts that describe hand, seed and sampling, as in `HandSamples`.
        recent: the cache of the chunks that were read last.

    >>> import tempfile
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.posture_model import SampleSpec
    >>> folder = write_samples(load_hand("barrett"), SampleSpec(100), tempfile.mkdtemp())
    >>> len(folder), folder.read(10).joints.shape, folder[-1][1].shape
    (100, torch.Size([10, 4]), torch.Size([6]))
    """

    folder: Path
    n: int
    joint_names: tuple[str, ...]
    meta: dict[str, str]
    recent: Recent[HandSamples] = dataclasses.field(
        default_factory=lambda: Recent(KEPT), repr=False, compare=False
    )

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, i: int) -> tuple[Tensor, Tensor]:
        """Return the joints (h,) [rad or m] and the contact code (6,) of posture i.

        A negative i counts from the end. Raises `IndexError` beyond the last posture, and
        `ModelFileError` for a missing or damaged chunk.
        """
        chunk, row = divmod(range(self.n)[operator.index(i)], CHUNK_POSTURES)
        samples = self.recent.get(chunk, self.chunk)
        # copies: callers may change them in place, and the chunk stays in memory
        return samples.joints[row].clone(), samples.q[row].clone()

    def __iter__(self) -> Iterator[HandSamples]:
        return (self.chunk(i) for i in range(len(chunk_sizes(self.n))))

    @checked
    def chunk(self, i: Chunk) -> HandSamples:
        """Read the postures of chunk i, counted from 0, and their contact codes.

        Each chunk has 10,000 postures (`CHUNK_POSTURES`); the last one has the rest.

        Raises `ModelFileError` if its file is missing, damaged, or belongs to other samples. Raises
        `BadArgument` for an index beyond the last chunk.
        """
        sizes = chunk_sizes(self.n)
        if i >= len(sizes):
            raise BadArgument("i", i, f"a chunk in [0, {len(sizes) - 1}]")
        path = self.path(i)
        tensors, meta = load_tensors(path, "samples", {"joints", "q"})
        shapes = tuple(tensors["joints"].shape), tuple(tensors["q"].shape)
        wanted = (sizes[i], len(self.joint_names)), (sizes[i], 6)
        if shapes != wanted:
            raise ModelFileError("path", f"{path}: tensors of shapes {shapes}", f"shapes {wanted}")
        if {key: meta.get(key) for key in self.meta} != self.meta or meta.get("chunk") != str(i):
            found = f"{path}: the chunk of other samples"
            raise ModelFileError("path", found, f"chunk {i} of {self.meta}")
        return HandSamples(tensors["joints"], tensors["q"], self.joint_names, dict(self.meta))

    @checked
    def read(self, n: Count | None = None) -> HandSamples:
        """Read the first `n` postures and their contact codes into memory; None means all.

        Raises `BadArgument` for n outside [1, len(folder)], and `ModelFileError` for a missing or
        damaged chunk.
        """
        n = self.n if n is None else n
        check_whole("n", n, 1, self.n)
        return join([self.chunk(i) for i in range(len(chunk_sizes(n)))])[:n]

    @checked
    def path(self, i: Chunk) -> Path:
        """Return the path of the file of chunk i, counted from 0. The file need not exist.

        Raises `BadArgument` for a negative index.
        """
        return self.folder / f"chunk-{i:06d}.safetensors"

    @checked
    def holds(self, i: Chunk) -> bool:
        """Return whether the file of chunk i, counted from 0, exists, is undamaged, and belongs to
        these samples.

        Raises `BadArgument` for an index beyond the last chunk.
        """
        try:
            self.chunk(i)
        except ModelFileError:
            return False
        return True


@checked
def write_samples(
    hand: Hand,
    spec: SampleSpec,
    folder: Path | str,
    workers: Annotated[int, Range(1, 1024)] = 1,
    observer: Callable[[int], object] = lambda count: None,
) -> SampleFolder:
    """Draw random postures of a hand, write them to a folder, and return the folder.

    The postures are those of `sample_configurations`, in files of 10,000 (chunks). A call with the
    same arguments continues an interrupted run.

    Args:
        hand: the hand, with three grasping fingers.
        spec: number of postures, seed and sampling.
        folder: the folder to write.
        workers: number of threads that draw at the same time, 1 to 1024.
        observer: function that is called at the start with the number of postures on disk. Later it
            gets the number in each new chunk.

    Raises:
        BadArgument: workers outside [1, 1024].
        BadArgument: a hand with another number of fingers, or of which almost no random posture is
            kept.
        OutputError: the folder holds other samples, another run is writing it, or the disk is full.

    >>> import tempfile
    >>> from torchgrasp import load_hand
    >>> from torchgrasp.posture_model import SampleSpec
    >>> len(write_samples(load_hand("barrett"), SampleSpec(100), tempfile.mkdtemp()))
    100
    """
    hand.require_three("hand", repr(hand.name))
    counts = chunk_sizes(spec.n)
    meta = spec.meta(hand)
    samples = SampleFolder(Path(folder), spec.n, hand.joint_names, meta)
    content = {"torchgrasp": "samples", "version": 1, "n": spec.n, "chunk": CHUNK_POSTURES}
    content |= {"joint_names": hand.joint_names, **meta}

    def write(i: int) -> int:
        joints, q, drawn = draw_chunk(hand, spec, i)
        chunk_meta = meta | {"chunk": str(i), "drawn": str(drawn)}
        save_tensors(samples.path(i), "samples", {"joints": joints, "q": q}, chunk_meta)
        return counts[i]

    with hold_folder(samples.folder):
        begin_folder(samples.folder / MANIFEST, json.dumps(content, indent=1) + "\n", "samples")
        # A damaged chunk is drawn again.
        missing = [i for i in range(len(counts)) if not samples.holds(i)]
        lacking = sum(counts[i] for i in missing)
        needed = 8 * lacking * (hand.dof + 6)
        free = shutil.disk_usage(samples.folder).free
        if free < needed:
            raise OutputError("folder", f"{folder}, {free} bytes free", f"{needed} bytes")
        observer(spec.n - lacking)
        pool = ThreadPoolExecutor(workers)
        try:
            for count in pool.map(write, missing):
                observer(count)
        # on an error or an interrupt, chunks under way are finished and the others never begun
        finally:
            pool.shutdown(cancel_futures=True)
    return samples


@checked
def load_samples(folder: Path | str) -> SampleFolder:
    """Open a complete folder of sampled postures that `write_samples` wrote.

    No posture is read yet. Raises `ModelFileError` for an unfinished folder or a damaged manifest.

    >>> import tempfile
    >>> from torchgrasp.hand.load import load_hand
    >>> folder = write_samples(load_hand("barrett"), SampleSpec(100), tempfile.mkdtemp()).folder
    >>> load_samples(folder).read(50).joints.shape
    torch.Size([50, 4])
    """
    folder = Path(folder)
    refuse = partial(ModelFileError, "folder")
    allowed = "a folder written by write_samples"
    manifest = read_json(folder / MANIFEST, refuse, allowed, MANIFEST_BYTES)
    samples = _parse_manifest(folder, manifest)
    chunks = len(chunk_sizes(samples.n))
    if missing := sum(not samples.path(i).is_file() for i in range(chunks)):
        allowed = "a finished folder: run the command that began it again"
        raise ModelFileError("folder", f"{folder} without {missing} of {chunks} chunks", allowed)
    return samples


def _parse_manifest(folder: Path, manifest: Field) -> SampleFolder:
    """Return the sample folder that a manifest (the JSON file of the folder) describes."""
    fixed = {"torchgrasp": "samples", "version": 1, "chunk": CHUNK_POSTURES}
    fields = manifest.entries()
    if any(key not in fields or fields[key].value != value for key, value in fixed.items()):
        raise manifest.wrong(f"a file with {fixed}")
    missing = {"n", "joint_names", *META_KEYS} - set(fields)
    if missing:
        raise manifest.wrong(f"a file with {min(missing)!r}")
    names = tuple(name.text() for name in fields["joint_names"].items())
    if not names:
        raise fields["joint_names"].wrong("the name of a joint")
    meta = {key: fields[key].text() for key in META_KEYS}
    return SampleFolder(folder, fields["n"].whole(1, MAX_SAMPLES), names, meta)
