#!/usr/bin/env python
"""Build wheel and sdist of the last commit. Try the wheel in an empty environment of every Python
there is.

    python scripts/package.py                                 with all Pythons that are found
    python scripts/package.py --python python3.10 python3.13  with these; with none it only builds
    python scripts/package.py --torch-index INDEX             with torch from this index

Nothing but Python, its venv module and git is needed. Environments are made one at a time and
removed.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OLDEST = 10
NEWEST = 14
"""Minor versions of Python 3 that are looked for."""
MOST_BYTES = 3_000_000
"""Of the wheel: what is downloaded each time."""
CLOUD = "torchgrasp/data/assets/jug/view.ply"
JOB = "grasp cloud.ply --hand allegro --starts 200 --out mine"
"""The cloud of the main job, and the job."""


def main() -> int:
    """Build wheel and sdist, check them, and try the wheel with each Python; return 0.

    A step that fails ends the script with a message.
    """
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=as_written)
    default = ROOT / "out/package"
    parser.add_argument(
        "--out", type=Path, default=default, help="folder of wheel, sdist, package.json"
    )
    parser.add_argument(
        "--python", nargs="*", help="interpreters; by default all of PATH and pyenv from 3.10 on"
    )
    parser.add_argument(
        "--torch-index", help="index that torch is taken from; by default where pip looks"
    )
    asked = parser.parse_args()
    if run("git", "status", "--porcelain", cwd=ROOT).strip():
        print("package: what is not committed is left out")
    # runs of torchgrasp clear away "torchgrasp-*"
    with tempfile.TemporaryDirectory(prefix="package-") as folder:
        work = Path(folder)
        wheel = build(work, asked.out.resolve())
        pythons = find_pythons() if asked.python is None else asked.python
        rows = [try_wheel(work, wheel, python, asked.torch_index) for python in pythons]
    (asked.out / "package.json").write_text(json.dumps(rows, indent=1))
    return 0


def run(*words: object, cwd: Path, codes: tuple[int, ...] = (0,), most: int = 3600) -> str:
    """Run a command in the folder `cwd`, and return what it printed.

    PYTHONPATH and PYTHONHOME are left out of its environment. The script ends with a message if the
    exit code is not one of `codes`. `most` is the time limit [s].
    """
    own = ("PYTHONPATH", "PYTHONHOME")
    clean = {name: value for name, value in os.environ.items() if name not in own}
    command = [str(x) for x in words]
    done = subprocess.run(command, cwd=cwd, env=clean, capture_output=True, text=True, timeout=most)
    if done.returncode not in codes:
        shown = "\n".join((done.stdout + done.stderr).splitlines()[-30:])
        sys.exit(f"package: {' '.join(command)} ended with {done.returncode}:\n{shown}")
    return done.stdout


def build(work: Path, out: Path) -> Path:
    """Build wheel and sdist from a clone of the last commit, check them; return the wheel's path.

    The script ends with a message if the wheel is too large or the sdist lacks a file. It ends also
    if the metadata are wrong. `work` is a scratch folder; the files are written to `out`.
    """
    tree = work / "tree"
    tools = work / "tools"
    run("git", "clone", "--quiet", "--no-hardlinks", ROOT, tree, cwd=work)
    run(sys.executable, "-m", "venv", tools, cwd=work)
    python = tools / "bin/python"
    run(python, "-m", "pip", "install", "--quiet", "build", "twine", cwd=work)
    run(python, "-m", "build", "--outdir", out, cwd=tree)  # the wheel is made from the sdist
    run(python, "-m", "build", "--wheel", "--outdir", work / "direct", cwd=tree)
    if left := run("git", "status", "--porcelain", cwd=tree):
        sys.exit(f"package: the build leaves files in the tree:\n{left}")
    (direct,) = (work / "direct").glob("*.whl")
    made = [out / direct.name, next(out.glob(f"{direct.name.split('-py3')[0]}.tar.gz"))]
    if made[0].read_bytes() != direct.read_bytes():
        sys.exit(
            "package: the wheel of the sdist is not that of the tree: the sdist lacks something"
        )
    run(python, "-m", "twine", "check", "--strict", *made, cwd=work)
    for path in made:
        megabytes = path.stat().st_size / 1e6
        print(f"{path.name}: {megabytes:.2f} MB, twine check --strict passed", flush=True)
    if direct.stat().st_size > MOST_BYTES:
        sys.exit(f"package: the wheel has more than {MOST_BYTES / 1e6:.0f} MB")
    return made[0]


def find_pythons() -> list[str]:
    """Return the path of an interpreter for each version of Python from 3.10 on that is found.

    Those of pyenv come before those of PATH. If none is found, it is this interpreter.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = []
    for minor in range(OLDEST, NEWEST + 1):
        own = sorted(pyenv.glob(f"3.{minor}.*/bin/python"))
        python = str(own[-1]) if own else shutil.which(f"python3.{minor}")
        if python is None:
            continue
        tried = subprocess.run([python, "-c", "import ensurepip"], capture_output=True)
        if tried.returncode == 0:
            found.append(python)
    return found or [sys.executable]


def try_wheel(work: Path, wheel: Path, interpreter: str, index: str | None) -> dict[str, object]:
    """Install the wheel in an empty environment, and run the main job and the self-test there.

    The main job is a plan on a cloud in an empty folder. The result has versions, sizes and what
    was printed. A step that fails ends the script. `index` is the index of torch; None means pip's.
    """
    environment = work / "environment"
    empty = work / "empty"
    run(interpreter, "-m", "venv", environment, cwd=work)
    empty.mkdir()
    python = environment / "bin/python"
    command = environment / "bin/torchgrasp"
    install = (python, "-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt")
    if index:
        run(*install, "torch", "--index-url", index, cwd=empty)
    run(*install, wheel, cwd=empty)
    packages = json.loads(run(python, "-m", "pip", "list", "--format", "json", cwd=empty))
    ask = "import platform, torch; print(platform.python_version(), torch.__version__, torch.version.cuda or 'none')"
    version, torch, cuda = run(python, "-c", ask, cwd=empty).split()
    gigabytes = size_of(environment / "lib") / 1e9
    shutil.copy(ROOT / CLOUD, empty / "cloud.ply")
    told = run(command, *JOB.split(), cwd=empty)
    missing = run(command, "doctor", cwd=empty, codes=(1,))
    if "sapien: pip install 'torchgrasp[sim]'" not in missing:
        sys.exit(f"package: doctor does not say how to install the simulator:\n{missing}")
    run(*install, f"torchgrasp[sim,mujoco] @ {wheel.as_uri()}", cwd=empty)
    run(command, "doctor", cwd=empty)
    verdicts = run(command, "selftest", cwd=empty)
    row = {
        "python": version,
        "torch": torch,
        "cuda": cuda,
        "packages": len([p for p in packages if p["name"] not in ("pip", "setuptools")]),
        "gigabytes": round(gigabytes, 2),
        "gigabytes_with_simulators": round(size_of(environment / "lib") / 1e9, 2),
        "grasp": next(line for line in told.splitlines() if "executable" in line).strip(),
        "verdicts": [line.strip() for line in verdicts.splitlines() if "verdicts right" in line],
    }
    print(", ".join(f"{name} {value}" for name, value in row.items()), flush=True)
    shutil.rmtree(environment)
    shutil.rmtree(empty)
    return row


def size_of(folder: Path) -> int:
    """Return the total size [bytes] of all files below a folder."""
    return sum(path.lstat().st_size for path in folder.rglob("*"))


if __name__ == "__main__":
    sys.exit(main())
