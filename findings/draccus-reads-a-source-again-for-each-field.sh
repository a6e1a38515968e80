#!/usr/bin/env bash
# draccus (the options of LeRobot's commands): parsing arguments reads the source of a dataclass again for each of its fields,
# also if nobody asks for help. For an inherited field it reads every class on the way to the one that has it. So a class of
# three generations with ten fields each costs 60 calls of inspect.getsource, each of which searches the file, and six
# generations cost 210: the count grows with the square. Commands that configure robots and cameras have hundreds of fields.
# A cache around inspect.getsource leaves the parsed values as they are.
# Packages: draccus 0.10.0; Python 3.11 or newer.
set -euo pipefail
place="$(mktemp -d)"
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place"
"$place/bin/python" -m pip install -qq --disable-pip-version-check draccus==0.10.0
cat > "$place/try.py" << 'END'
import functools
import importlib
import inspect
import pathlib
import sys
from importlib.metadata import version

import draccus

FIELDS = 10
real = inspect.getsource
calls = []


def counted(thing):
    calls.append(thing.__name__)
    return real(thing)


def generations(count):
    """Return the last of `count` dataclasses, each of which adds `FIELDS` fields to the one before."""
    lines = ["import dataclasses", ""]
    for k in range(count):
        base = f"(Part{k - 1})" if k else ""
        lines += ["@dataclasses.dataclass", f"class Part{k}{base}:"]
        lines += [f"    value_{k}_{i}: int = {i}  # number {i}" for i in range(FIELDS)]
    name = f"parts_{count}"
    pathlib.Path(sys.argv[1], f"{name}.py").write_text("\n".join(lines) + "\n")
    return getattr(importlib.import_module(name), f"Part{count - 1}")


sys.path.insert(0, sys.argv[1])
inspect.getsource = counted
found = {}
for count in (1, 3, 6):
    calls.clear()
    parsed = draccus.parse(generations(count), args=["--value_0_0", "7"])
    assert parsed.value_0_0 == 7
    found[count] = len(calls)
    print(f"draccus {version('draccus')}: {count * FIELDS} fields in {count} generations, sources read {len(calls)} times")
assert found == {k: FIELDS * k * (k + 1) // 2 for k in (1, 3, 6)}, found

inspect.getsource = functools.cache(counted)
calls.clear()
cached = draccus.parse(generations(6), args=["--value_0_0", "7"])
print(f"with a cache: {len(calls)} times, the same values: {vars(cached) == vars(parsed)}")
assert len(calls) == 6 and vars(cached) == vars(parsed)
END
"$place/bin/python" "$place/try.py" "$place"
