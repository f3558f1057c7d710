"""Read a donkeycar tub (version 2): manifest.json, catalog_*.catalog and images/.

The format: donkeycar's `parts/tub_v2.py` and `parts/datastore_v2.py`. Its angle is -1..1, right positive.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cloning.base.errors import RecordingError
from cloning.lerobot.source import Sample, decoded

MANIFEST = "manifest.json"
FRAME_SECONDS = 0.05  # donkeycar's usual 20 rows a second, for tubs without times


def read_tub(folder: Path, camera: str | None, notes: Counter[str]) -> Iterator[Sample]:
    """Yield the rows that a person drove and that are not marked as deleted; camera: an input, or None for the usual.

    notes: is added to what does not fit, and how often. Raises RecordingError.
    """
    camera = camera or "cam/image_array"
    lines = list(_lines(folder / MANIFEST).values())
    try:
        paths, deleted = [folder / name for name in lines[4]["paths"]], set(lines[4].get("deleted_indexes") or ())
    except (AttributeError, IndexError, KeyError, TypeError):
        remedy = "line 5 names no catalogs: not of a tub of version 2; copy it again"
        raise RecordingError(f"{folder / MANIFEST}: {remedy}") from None
    index = -1
    for path in paths:
        for line, row in _lines(path).items():
            index += 1
            try:
                if index in deleted:
                    notes["a row that is marked as deleted is left out"] += 1
                elif row.get("user/mode", "user") != "user":
                    notes[f"a row that the {row['user/mode']} drove is left out"] += 1
                elif (
                    not (file := folder / "images" / row[camera]).is_file()
                    or (image := decoded(file.read_bytes())) is None
                ):
                    notes["a row whose image is missing or damaged is left out"] += 1
                else:
                    time = row["_timestamp_ms"] / 1000 if "_timestamp_ms" in row else index * FRAME_SECONDS
                    throttle = {"throttle": float(row["user/throttle"])} if "user/throttle" in row else {}
                    yield Sample(time, [image], {"steering": float(row["user/angle"]), **throttle})
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                problem = f"no {error}" if isinstance(error, KeyError) else str(error)
                raise RecordingError(f"{path}: line {line}: {problem}; correct or delete the line") from None


def _lines(path: Path) -> dict[int, Any]:
    """Return the JSON in each line of a file that is not empty, by the line's number. Raises RecordingError."""
    found, number = dict[int, Any](), 0
    try:
        for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if text:  # donkeycar 4.0 ends its lines with \r\r\n on Windows
                found[number] = json.loads(text)
        return found
    except ValueError as error:
        raise RecordingError(f"{path}: line {number}: {error}; copy the file again, or delete the line") from None
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; copy it again") from None
