"""Read a drive that drive.py saved: frames of the centre camera, and driven.csv beside them."""

import re
from collections import Counter
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

from cloning.base.errors import RecordingError
from cloning.lerobot.source import Sample
from cloning.recordings.images import decode, read_jpeg
from cloning.recordings.saved_frames import DRIVEN, DRIVEN_COLUMNS, taken_at

NUMBER = r",(-?\d+\.?\d*(?:e-\d+)?)"
# At the end of a line, which begins with a part of another row if the disk was full in the middle of that.
ROW = re.compile(rf"(\d{{4}}(?:_\d\d){{5}}_\d{{3}}\.jpg){NUMBER * 3}\n", re.ASCII)


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
