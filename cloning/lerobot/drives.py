"""Read drives that others saved: donkeycar's tubs, and the frames and driven.csv of drive.py.

A tub (version 2) has manifest.json, catalog_*.catalog and images/: see donkeycar's `parts/tub_v2.py` and
`parts/datastore_v2.py`. Its angle is -1..1, right positive.
"""

import json
import re
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from cloning.base.errors import RecordingError
from cloning.lerobot.source import Sample, chosen_camera, decoded
from cloning.recordings.images import decode, read_jpeg
from cloning.recordings.saved_frames import DRIVEN, DRIVEN_COLUMNS, taken_at

MANIFEST = "manifest.json"
FRAME_SECONDS = 0.05  # donkeycar's usual 20 rows a second, for tubs without times
# Names of steering and throttle, of a person and of donkeycar's template of computer vision
PERSON, TEMPLATE = ("user/angle", "user/throttle"), ("steering", "throttle")
NUMBER = r",(-?\d+\.?\d*(?:e-\d+)?)"
# At the end of a line, which begins with a part of another row if the disk was full in the middle of that.
ROW = re.compile(rf"(\d{{4}}(?:_\d\d){{5}}_\d{{3}}\.jpg){NUMBER * 3}\n", re.ASCII)


def read_tub(folder: Path, camera: str | None, notes: Counter[str]) -> Iterator[Sample]:
    """Yield the rows that a person drove and that are not marked as deleted; camera: an input, or None for the usual.

    notes: is added to what does not fit, and how often. Raises RecordingError.
    """
    lines = list(_lines(folder / MANIFEST, None).values())
    try:
        cameras = [name for name, kind in zip(*lines[:2], strict=False) if kind == "image_array"]
        paths, deleted = [folder / name for name in lines[4]["paths"]], set(lines[4].get("deleted_indexes") or ())
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        remedy = "line 5 names no catalogs: not of a tub of version 2; copy it again"
        raise RecordingError(f"{folder / MANIFEST}: {remedy}") from None
    usual = "cam/image_array"
    camera = chosen_camera(cameras, usual if camera is None and usual in cameras else camera)
    index = -1
    for path in paths:
        for line, row in _lines(path, notes if path == paths[-1] else None).items():
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
                    angle, throttle = TEMPLATE if "steering" in row and "user/angle" not in row else PERSON
                    more = {"throttle": float(row[throttle])} if throttle in row else {}
                    yield Sample(time, [image], {"steering": float(row[angle]), **more})
            except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
                problem = f"no {error}" if isinstance(error, KeyError) else str(error)
                raise RecordingError(f"{path}: line {line}: {problem}; correct or delete the line") from None


def _lines(path: Path, notes: Counter[str] | None) -> dict[int, Any]:
    """Return the JSON in each line of a file that is not empty, by the line's number. Raises RecordingError.

    notes: is added to if the last line is cut short, as by a power failure; None: then that is an error, too.
    """
    found, number, text = dict[int, Any](), 0, ""
    try:
        for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(keepends=True), 1):
            if text.strip():  # donkeycar 4.0 ends its lines with \r\r\n on Windows
                found[number] = json.loads(text)
        return found
    except ValueError as error:
        if notes is not None and number and not text.endswith("\n"):
            notes["a row at the end that is cut short is left out"] += 1
            return found
        raise RecordingError(f"{path}: line {number}: {error}; copy the file again, or delete the line") from None
    except OSError as error:
        raise RecordingError(f"{path}: {error.strerror}; copy it again") from None


def read_driven(folder: Path, notes: Counter[str]) -> Iterator[Sample]:
    """Yield the frames of a saved drive, with the network's steering; notes: is added to what does not fit.

    Raises RecordingError.
    """
    path = folder / DRIVEN
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines(keepends=True) or [""]
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: {error}; drive again") from None
    if header.strip() != ",".join(DRIVEN_COLUMNS):
        raise RecordingError(f"{path}: line 1: not {','.join(DRIVEN_COLUMNS)}: not of drive.py; drive again")
    for line in lines:
        row = ROW.search(line)
        moment = taken_at(row[1]) if row else None
        if not row or not moment:
            notes[f"a row of {DRIVEN} that is cut short is left out"] += 1
            continue
        try:
            frame = decode(read_jpeg(folder / row[1]))
        except ValueError:
            notes["a row whose image is missing or damaged is left out"] += 1
            continue
        numbers = dict(zip(("steering", "throttle", "speed"), map(float, row.groups()[1:]), strict=True))
        yield Sample((moment - datetime(1970, 1, 1)).total_seconds(), [frame], {**numbers, "brake": 0.0})
