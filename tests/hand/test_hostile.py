"""Hostile hands: whatever a URDF, a hand.toml or a model file holds, it is refused by name or read
for what it is.

The corpus is read in a process of its own whose files, memory and time are watched: nothing outside
the hand's folder is opened, nothing is run, and little is allocated.
"""

import json
import pickle
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.apart import run_apart
from torchgrasp import load_mixture
from torchgrasp.app.author.draft import draft_hand, new_hand
from torchgrasp.foundation.errors import GraspError, HandFileError, ModelFileError
from torchgrasp.hand.load import hands_folder, load_hand

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def chain(n: int, close: bool = False) -> str:
    """A tree of n links in one line; `close` makes it a ring."""
    links = "".join(f'<link name="c{k}"/>' for k in range(n))
    ends = [(k, k + 1) for k in range(n - 1)] + ([(n - 1, 0)] if close else [])
    joints = "".join(
        f'<joint name="q{a}" type="fixed"><parent link="c{a}"/><child link="c{b}"/></joint>'
        for a, b in ends
    )
    return links + joints


END = "</robot>"
MESH = '<link name="v"><{0}><geometry><mesh filename="{1}"/></geometry></{0}></link>'
MESH += '<joint name="w" type="fixed"><parent link="base"/><child link="v"/></joint>'

NAMES = (
    "../secret.stl",
    "../../../../etc/secret.stl",
    "/etc/secret.stl",
    "/dev/zero",
    "file:///etc/secret.stl",
    "FILE:x.stl",
    "http://localhost/x.stl",
    "package://claw/../../x.stl",
    "a\\..\\x.stl",
    "x" * 5000 + ".stl",
    "",
    "x.dae",
    "x.stl/../../../x.stl",
    "link.stl",
    "pipe.stl",
    "folder.stl",
    "huge.stl",
    "&#0;.stl",
)
"""Files of meshes. A visual one is never opened, so its name does no harm."""


def urdf_corpus(good: str) -> dict[str, str | bytes]:
    """Name broken and hostile variants of a good URDF (the claw's)."""
    body = good.removesuffix(END)
    corpus: dict[str, str | bytes] = {
        "entity bomb": '<!DOCTYPE r [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
        + good,
        "external entity": '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + good,
        "external dtd": '<!DOCTYPE r SYSTEM "http://localhost/x.dtd">' + good,
        "parameter entity": '<!DOCTYPE r [<!ENTITY % p SYSTEM "file:///etc/hostname"> %p;]>' + good,
        "included file": body
        + '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/passwd"/>'
        + END,
        "utf-16": good.encode("utf-16"),
        "utf-16 without a mark": good.encode("utf-16-le"),
        "utf-7 declared": '<?xml version="1.0" encoding="utf-7"?>' + good,
        "latin-1": good.replace("claw", "cl\xe4w").encode("latin-1"),
        "zero byte": good.replace("claw", "cl\0w"),
        "zero by number": good.replace('"claw"', '"cl&#0;w"'),
        "a zip": b"PK\x03\x04" + bytes(200),
        "a pickle": pickle.dumps({"a": 1}),
        "20 MB attribute": good.replace('"claw"', '"' + "a" * 20_000_000 + '"'),
        "long name": body + f'<link name="{"a" * 3_000_000}"/>' + END,
        "deep": body + "<link>" * 100_000 + "</link>" * 100_000 + END,
        "many elements": body + "<material/>" * 200_000 + END,
        "ring of 500": f'<robot name="r">{chain(500, close=True)}</robot>',
        "line of 600": f'<robot name="r">{chain(600)}</robot>',
        "continuous joint": good.replace('type="revolute"', 'type="continuous"', 1),
        "overflowing limit": good.replace('upper="0.5"', 'upper="1e999"', 1),
        "a million digits": good.replace('upper="0.5"', f'upper="{"1" * 1_000_000}"', 1),
        "almost a number": good.replace('upper="0.5"', f'upper="{"1" * 1_000_000}x"', 1),
        "underscored number": good.replace('upper="0.5"', 'upper="0_0.5"', 1),
        "other digits": good.replace('upper="0.5"', 'upper="\u0661.5"', 1),
        "comma": good.replace('upper="0.5"', 'upper="0,5"', 1),
        "mimic loop": good.replace('joint="left_bend"', 'joint="right_follow"').replace(
            'joint="right_bend"', 'joint="left_follow"'
        ),
        "mimic of a fixed joint": good.replace('joint="left_bend"', 'joint="left_end"'),
        "box without size": good.replace('<box size="0.11 0.1 0.03"/>', "<box/>"),
    }
    for name in NAMES:
        corpus[f"mesh {name[:30]!r}"] = body + MESH.format("collision", name) + END
        corpus[f"seen {name[:30]!r}"] = body + MESH.format("visual", name) + END
    return corpus


def toml_corpus(good: str) -> dict[str, str | bytes]:
    """Name broken and hostile variants of a good hand.toml that are no change of one value's type."""
    return {
        "latin-1": good.replace("claw", "cl\xe4w").encode("latin-1"),
        "utf-16": good.encode("utf-16"),
        "cut": good[: len(good) // 2],
        "deep": good + "x = " + "[" * 50_000 + "]" * 50_000,
        "key twice": good.replace('name = "claw"', 'name = "claw"\nname = "claw"'),
        "2 MB": good + "# " + "x" * 2_000_000,
        "a key of 20,000 parts": ".".join("a" * 20_000) + " = 1\n" + good,
        "urdf outside": good.replace('"claw.urdf"', '"../secret.urdf"'),
        "urdf by a path": good.replace('"claw.urdf"', '"/etc/passwd"'),
        "urdf by a link": good.replace('"claw.urdf"', '"link.urdf"'),
        "urdf that is a folder": good.replace('"claw.urdf"', '"."'),
        "many fingers": good + "[[finger]]\n" * 5000,
        "mimic given as free": good[: good.index("[coupling]")]
        + good[good.index("[options.default]") :],
        "another ratio": good.replace("ratio = -0.7", "ratio = 0.7", 1),
        "parked and grasping": good.replace(
            "[options.default]", "[options.default]\nparked = { left_bend = 0.0 }"
        ),
    }


def prepare(folder: Path) -> tuple[str, str]:
    """Put into the folder what the corpus names, and return the good texts that are there."""
    (folder / "link.stl").symlink_to("/dev/zero")
    (folder / "link.urdf").symlink_to("/etc/passwd")
    (folder / "folder.stl").mkdir()
    with (folder / "huge.stl").open("wb") as file:
        file.truncate(2**33)  # says so, and occupies nothing
    import os

    os.mkfifo(folder / "pipe.stl")
    return (folder / "claw.urdf").read_text(), (folder / "hand.toml").read_text()


def outcome(action: Callable[[], object]) -> str:
    """Tell what came of reading a file."""
    try:
        action()
        return "accepted"
    except HandFileError as error:
        return "refused" if len(str(error)) < 2000 else "refused at length"
    except Exception as error:
        return repr(error)[:200]


def outcomes(folder: Path) -> dict[str, str]:
    """Load the hand with each file of the corpus in the place of the good one, and tell what came
    of it.
    """
    urdf, toml = prepare(folder)
    found = {}
    for file, good, corpus in (
        ("claw.urdf", urdf, urdf_corpus(urdf)),
        ("hand.toml", toml, toml_corpus(toml)),
    ):
        for name, content in corpus.items():
            assert content != good, name
            (folder / file).write_bytes(content if isinstance(content, bytes) else content.encode())
            found[f"{file}: {name}"] = outcome(lambda: load_hand(folder))
            if file == "claw.urdf" and not name.startswith("seen"):
                found[f"new: {name}"] = outcome(lambda: new_hand(folder / "claw.urdf"))
        (folder / file).write_text(good)
    return found


WATCHED = """
import importlib.util, json, os, resource, sys
from pathlib import Path

spec = importlib.util.spec_from_file_location("hostile", sys.argv[1])
module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
folder = Path(sys.argv[2]).resolve()
from torchgrasp.hand.load import load_hand
load_hand(folder)  # what is imported late is imported now
module.new_hand(next(folder.glob("*.urdf")))
module.urdf_corpus(module.END)
seen = []

def watch(event, arguments):
    if event == "open":
        path = os.path.realpath(os.fsdecode(arguments[0])) if not isinstance(arguments[0], int) else ""
        if not path.startswith(str(folder)) and not path.endswith((".toml.jinja", ".urdf.jinja")):  # the library's own
            seen.append(f"open {path}")
    elif event.split(".")[0] in ("socket", "subprocess", "ctypes", "pickle", "urllib") or event in (
        "os.system", "os.exec", "os.posix_spawn", "os.fork", "os.remove", "os.rename"
    ):
        seen.append(event)

pages = int(Path("/proc/self/statm").read_text().split()[0])
sys.addaudithook(watch)
most = pages * resource.getpagesize() + 200 * 2**20
resource.setrlimit(resource.RLIMIT_AS, (most, most))
used = resource.getrusage(resource.RUSAGE_SELF).ru_utime
resource.setrlimit(resource.RLIMIT_CPU, (int(used) + 60, int(used) + 60))
found = module.outcomes(folder)
print(json.dumps({"outcomes": found, "seen": seen[:20]}))
"""


@pytest.mark.promise("I13", "H1", "H2", "H3")
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="limits are set as on Linux")
def test_hostile_hands_are_refused_and_open_nothing(claw, tmp_path):
    (claw.parent / "hand.toml").write_text(draft_hand(claw))
    words = [__file__, str(claw.parent)]
    begin = f"import os, sys; os.chdir({str(tmp_path)!r}); sys.argv[1:] = {words!r}"
    (told,) = run_apart(begin + WATCHED)
    said = json.loads(told.splitlines()[-1])
    assert len(said["outcomes"]) >= 60
    # what is only seen is not read; a joint without limits is repaired
    harmless = {f"claw.urdf: seen {name[:30]!r}" for name in NAMES} | {"new: continuous joint"}
    assert {name for name, what in said["outcomes"].items() if what != "refused"} <= harmless
    assert said["seen"] == []


WRONG: tuple[Any, ...] = (-1.5, True, "word", [], {"a": 1}, [[]], float("nan"), 10**400)


def written(value: Any) -> str:
    """Write a value as inline TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {written(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(written, value)) + "]"
    return json.dumps(value).replace("NaN", "nan")


def places(value: Any, path: tuple[Any, ...] = ()):
    """Yield the path of every value inside a table."""
    for key, inner in (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    ):
        yield (*path, key)
        yield from places(inner, (*path, key))


def replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    """Return a table with one value replaced, or removed for `...`."""
    if not path:
        return new
    key = path[0]
    rest = path[1:]
    items = list(value.items() if isinstance(value, dict) else enumerate(value))
    changed = [
        (k, replaced(v, rest, new) if k == key else v)
        for k, v in items
        if (k, new, rest) != (key, ..., ())
    ]
    return dict(changed) if isinstance(value, dict) else [v for _, v in changed]


@pytest.mark.promise("H5")
def test_every_value_of_a_hand_toml_in_every_wrong_type(claw):
    """A value of another type is refused by name, or is as good as the old one; nothing else ends
    the reading.
    """
    good = tomllib.loads(draft_hand(claw))
    good["self_collision"]["pairs"] = good["self_collision"]["pairs"][:2]
    target = claw.parent / "hand.toml"
    accepted = []
    refused = []
    paths = [p for p in places(good) if not (p[0] == "finger" and len(p) > 1 and p[1] != 0)]
    for path in paths:
        for new in (*WRONG, ...):
            table = replaced(good, path, new)
            target.write_text(
                "\n".join(f"{json.dumps(k)} = {written(v)}" for k, v in table.items())
            )
            try:
                load_hand(claw.parent)
                accepted.append((path, new))
            except GraspError as error:
                refused.append(str(error))
    assert len(paths) > 50 and len(refused) > 300
    assert all(any(word in said for word in ("hand.toml", "urdf", "fingers")) for said in refused)
    for path, new in accepted:  # what remains means something else, but means it
        number = isinstance(new, (int, float)) and not isinstance(new, bool)
        left_out = new in (..., [], {}) and (
            path[0] == "self_collision" or isinstance(path[-1], int)
        )
        assert number or left_out or (path[-1] == "name" and new == "word"), (path, new)


@pytest.mark.promise("H4")
def test_model_files_cut_or_changed_are_refused(tmp_path):
    whole = (hands_folder() / "barrett" / "mixture.safetensors").read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    rng = np.random.default_rng(0)
    path = tmp_path / "mixture.safetensors"
    for n in [*range(0, header + 1, 5), *rng.integers(header, len(whole), 50).tolist()]:
        path.write_bytes(whole[:n])
        with pytest.raises(ModelFileError):
            load_mixture(path)
    for at in rng.integers(0, header, 100).tolist():
        path.write_bytes(
            whole[:at] + bytes([whole[at] ^ (1 << int(rng.integers(8)))]) + whole[at + 1 :]
        )
        try:
            load_mixture(path)  # a letter of the metadata
        except ModelFileError:
            pass


@pytest.mark.promise("H4")
def test_other_model_files_are_refused(tmp_path):
    whole = (hands_folder() / "barrett" / "mixture.safetensors").read_bytes()

    class Payload:
        def __reduce__(self):
            return (Path(tmp_path / "run").touch, ())

    path = tmp_path / "mixture.safetensors"
    torch.save({"weights": torch.ones(1)}, tmp_path / "torch.pt")
    with zipfile.ZipFile(tmp_path / "some.zip", "w") as archive:
        archive.writestr("weights", "x")
    contents = {
        "empty": b"",
        "huge header": (2**62).to_bytes(8, "little") + whole[8:],
        "header of 100 MB": (100 * 2**20).to_bytes(8, "little") + whole[8:],
        "trailing bytes": whole + b"more",
        "pickle": pickle.dumps(Payload()),
        "torch": (tmp_path / "torch.pt").read_bytes(),
        "zip": (tmp_path / "some.zip").read_bytes(),
        "deep header": (200_000).to_bytes(8, "little") + b"[" * 200_000,
    }
    for content in contents.values():
        path.write_bytes(content)
        with pytest.raises(ModelFileError, match="path"):
            load_mixture(path)
    assert not (tmp_path / "run").exists()


def test_a_name_from_a_file_does_not_fill_a_message(claw):
    target = claw.parent / "hand.toml"
    target.write_text(draft_hand(claw).replace("options.default", "options." + "d" * 20_000))
    with pytest.raises(GraspError, match=r"d{500}") as refused:
        load_hand(claw.parent)
    assert len(str(refused.value)) < 2000
