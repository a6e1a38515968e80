"""Reads a recording as others do: python read_recording.py FILE OUT, in the environment
.beside/rerun.

OUT gets, for each entity, the timelines and their values, and the rows of each component, as JSON.
"""

import json
import sys


def read_entities(path: str) -> dict[str, dict[str, list[object]]]:
    """Return the columns of every entity, with those of timelines named after what they belong to."""
    from rerun.chunk import RrdReader  # the environment of the tests lacks it

    found: dict[str, dict[str, list[object]]] = {}
    for chunk in RrdReader(path).store().stream():
        batch = chunk.to_record_batch()
        entity = found.setdefault(chunk.entity_path, {})
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            values = column.to_pylist()
            if name in chunk.timeline_names:
                values = [x.total_seconds() if hasattr(x, "total_seconds") else x for x in values]
                name = f"{name} of {batch.schema.names[-1].split(':')[0]}"
            if not name.startswith("rerun."):
                entity.setdefault(name, []).extend(values)
    return found


if __name__ == "__main__":
    with open(sys.argv[2], "w") as file:
        json.dump(read_entities(sys.argv[1]), file)
