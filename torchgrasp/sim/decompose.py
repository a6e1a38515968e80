"""CoACD in a process of its own, which is bounded in time and memory and ends with its parent.

CoACD knows no limits, and a signal would wait for it: a torus of 2000 faces that crosses itself takes minutes.
"""

import importlib.util
import io
import json
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from torchgrasp.errors import MeshError, MissingExtra

if TYPE_CHECKING:
    import trimesh

SECONDS, SECONDS_PER_FACE = 60.0, 0.005
"""Processor time that a mesh may take [s]: three times what scans of 800 to 16000 faces took at most."""
MOST_MEMORY = 4 * 1024**3
"""Address space of the process [bytes]; a scan of 13,000 faces takes 0.3 GiB."""
WAITING = 10.0
"""Wall time allowed for each second of processor time, on a busy machine."""

CHILD = """
import sys
sys.path[:] = sys.argv[2:]
import io, json, os, threading, time
asked = json.loads(sys.argv[1])
parent = os.getppid()
def follow():
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)
threading.Thread(target=follow, daemon=True).start()
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CPU, (asked["seconds"], asked["seconds"]))
    resource.setrlimit(resource.RLIMIT_AS, (asked["memory"], asked["memory"]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
except ImportError:
    pass  # Windows, where the parent's clock has to do
import numpy, coacd
out = os.dup(1)
os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # where CoACD prints
coacd.set_log_level("off")
given = numpy.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False)
parts = coacd.run_coacd(coacd.Mesh(given["vertices"], given["faces"]), seed=0, **asked["search"])
buffer = io.BytesIO()
numpy.savez(buffer, **{f"{name}{k}": x for k, part in enumerate(parts) for name, x in zip("vf", part)})
with os.fdopen(out, "wb") as pipe:
    pipe.write(buffer.getvalue())
"""
"""The program of the process, which needs numpy and coacd alone. It finds them where this one does."""


def decompose(mesh: "trimesh.Trimesh", search: dict[str, Any]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return vertices and faces of the convex parts that CoACD cuts a mesh into, quietly.

    Raises:
        MeshError: it takes more time or memory than its size allows; most often a mesh that crosses itself.
        MissingExtra: CoACD is not installed.
    """
    if importlib.util.find_spec("coacd") is None:
        raise MissingExtra("coacd", "sim")
    seconds = int(SECONDS + SECONDS_PER_FACE * len(mesh.faces))
    asked = json.dumps({"seconds": seconds, "memory": MOST_MEMORY, "search": search})
    buffer = io.BytesIO()
    np.savez(buffer, vertices=mesh.vertices, faces=mesh.faces)
    command = [sys.executable, "-c", CHILD, asked, *filter(None, sys.path)]
    try:
        ended = subprocess.run(command, input=buffer.getvalue(), capture_output=True, timeout=WAITING * seconds)
        with np.load(io.BytesIO(ended.stdout), allow_pickle=False) as found:
            return [(found[f"v{k}"], found[f"f{k}"]) for k in range(len(found) // 2)]
    except (subprocess.TimeoutExpired, OSError, ValueError, EOFError, KeyError) as error:
        found = f"{len(mesh.faces)} faces that CoACD cannot cut in {seconds} s and {MOST_MEMORY >> 30} GiB"
        raise MeshError(
            "mesh", found, "a mesh that does not cross itself, with fewer faces; or give `parts`"
        ) from error
