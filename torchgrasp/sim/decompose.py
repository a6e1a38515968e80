"""Cut meshes into convex parts by CoACD, in a separate process with limits of time and memory.

CoACD itself has no limits and delays signals. The process runs this file, which needs only numpy
and CoACD, and ends with its parent process.
"""

import importlib.util
import io
import json
import os
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import trimesh

# processor time [s] that a mesh may take, and further time [s] for each face
SECONDS = 60.0
SECONDS_PER_FACE = 0.005
WALL = 10.0  # time limit on a busy machine, over the processor time
GIBIBYTES = 4  # memory that a mesh may take
GIBIBYTE = 2**30


def decompose(
    mesh: "trimesh.Trimesh", search: dict[str, Any]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the vertices (v, 3) [m] and faces (f, 3) of each convex part of a mesh, cut by CoACD.

    The parts are in the mesh's frame. `search` holds CoACD's settings by name. Raises
    `MissingExtra` if CoACD is not installed, and `MeshError` if it fails. It also fails beyond
    4 GiB of memory, or beyond 60 s of processor time plus 5 ms a face.
    """
    from torchgrasp.foundation.errors import MeshError, MissingExtra

    if importlib.util.find_spec("coacd") is None:
        raise MissingExtra("coacd", "sim")
    seconds = int(SECONDS + SECONDS_PER_FACE * len(mesh.faces))
    memory = GIBIBYTES * GIBIBYTE
    asked = json.dumps({"seconds": seconds, "memory": memory, "search": search})
    buffer = io.BytesIO()
    np.savez(buffer, vertices=mesh.vertices, faces=mesh.faces)
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PYTHONSAFEPATH": "1"}
    try:
        ended = subprocess.run(
            [sys.executable, __file__, asked],
            input=buffer.getvalue(),
            capture_output=True,
            timeout=WALL * seconds,
            env=os.environ | paths,
        )
        with np.load(io.BytesIO(ended.stdout), allow_pickle=False) as found:
            return [(found[f"v{k}"], found[f"f{k}"]) for k in range(len(found) // 2)]
    except (subprocess.TimeoutExpired, OSError, ValueError, EOFError, KeyError) as error:
        found = f"{len(mesh.faces)} faces that CoACD cannot cut in {seconds} s and {GIBIBYTES} GiB"
        allowed = "a mesh that does not cross itself, with fewer faces; or give `parts`"
        raise MeshError("mesh", found, allowed) from error


def main(asked: dict[str, Any]) -> None:
    """Read a mesh from stdin, cut it by CoACD, and write its convex parts to stdout.

    Both are .npz files. The mesh has `vertices` (v, 3) [m] and `faces` (f, 3); the parts have `v0`,
    `f0`, `v1`, `f1` and so on. `asked` holds limits of "seconds" [s] and "memory" [bytes], and the
    settings of CoACD by name in "search".
    """
    threading.Thread(target=_end_with_parent, args=(os.getppid(),), daemon=True).start()
    _limit(asked["seconds"], asked["memory"])
    import coacd

    out = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # CoACD prints here
    coacd.set_log_level("off")
    given = np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False)
    mesh = coacd.Mesh(given["vertices"], given["faces"])
    arrays = {}
    for k, part in enumerate(coacd.run_coacd(mesh, seed=0, **asked["search"])):
        arrays[f"v{k}"], arrays[f"f{k}"] = part
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    with os.fdopen(out, "wb") as pipe:
        pipe.write(buffer.getvalue())


def _end_with_parent(parent: int) -> None:
    """End this process once its parent process has ended."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _limit(seconds: int, memory: int) -> None:
    """Limit CPU time [s] and address space [bytes], if the system can; otherwise the parent's
    timeout applies.
    """
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
