"""Read a data set in LeRobot's format v3, or v2, as samples of a recording."""

import json
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cloning.base.errors import RecordingError
from cloning.lerobot.dataset import ACTION, RECORDED_AT
from cloning.lerobot.source import Sample, chosen_camera, decoded
from cloning.recordings.columns import column_of
from cloning.recordings.format import CAMERAS, NUMBERS

INFO = "meta/info.json"
# What reading a file raises that is another than LeRobot's, or damaged
WRONG = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, pa.ArrowException)
CLONE = "or run `git lfs pull` where git has cloned it"
REORDERED = 16  # frames at most that a film stores after a key frame, but shows before it
MOST_NUMBERS = 1000  # of a feature without names; a damaged file may tell of any number


def read_data_set(folder: Path, camera: str | None, steering: str | None) -> Iterator[Sample]:
    """Yield the rows of all episodes in their order.

    camera: the feature with the frames of the camera that looks ahead; steering: FEATURE:NAME of the steering; both
    None if that is clear. Raises RecordingError, with the names that there are, and OSError.
    """
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
        yield from _rows(folder, info, _cameras(info, camera), _columns(info, steering))
    except av.FFmpegError as error:
        raise RecordingError(f"{error.filename or folder}: {error.strerror}; copy the film again, {CLONE}") from error
    except FileNotFoundError as error:  # of PyArrow, without the reason
        raise RecordingError(f"{error.filename or error}: no such file; copy it again") from error
    except WRONG as error:
        problem = f"{type(error).__name__}: {error}; copy it again, {CLONE}"
        raise RecordingError(f"not a data set in LeRobot's format v3 or v2: {problem}") from error


def _cameras(info: dict[str, Any], camera: str | None) -> list[str]:
    """Return the features with the frames of the centre, left and right camera, or with those of the only one."""
    keys = [key for key, feature in info["features"].items() if feature["dtype"] in ("video", "image")]
    three = [next((key for key in keys if key.endswith(f".{name}")), "") for name in CAMERAS]
    if camera is None and all(three):
        return three
    return [chosen_camera(keys, camera)]


def _columns(info: dict[str, Any], steering: str | None) -> dict[str, tuple[str, int]]:
    """Return the feature of each number of a recording that is found, and the number's place in it."""
    found, places = {}, {}
    for key, each in info["features"].items():
        count = min(each["shape"][0], MOST_NUMBERS) if len(each["shape"]) == 1 else 0
        names = each.get("names") or ([key.rpartition(".")[2]] if count == 1 else [str(at) for at in range(count)])
        # Also {"motors": [...]}, [[...]], or each name with its place
        while isinstance(names, dict) or isinstance(next(iter(names), None), list):
            first = next(iter(names.values()), ()) if isinstance(names, dict) else names[0]
            names = sorted(names, key=names.__getitem__) if isinstance(first, int) else first
        for at, name in enumerate(names if count else []):
            places[f"{key}:{name}"] = key, at
            meaning, is_mph = column_of(str(name)), (each.get("units") or [""])[0] == "mph"
            if meaning in NUMBERS and (meaning not in found or key == ACTION) and (meaning != "speed" or is_mph):
                found[meaning] = key, at
    if steering is not None:
        found.pop("steering", None)
        if steering in places:
            found["steering"] = places[steering]
    if "steering" not in found:
        raise RecordingError(f"which number is the steering? Name it with --steering: {', '.join(places) or 'none'}")
    return found


def _rows(folder: Path, info: dict[str, Any], keys: list[str], columns: dict[str, tuple[str, int]]) -> Iterator[Sample]:
    read = lru_cache(1)(pq.read_table)
    for episode in _episodes(folder, info):
        where = {name.rpartition("/")[2]: value for name, value in episode.items() if name.startswith("data/")}
        table = read(folder / info["data_path"].format(**where, **episode))
        table = table.filter(pa.compute.equal(table["episode_index"], episode["episode_index"]))
        times = np.asarray(table[RECORDED_AT if RECORDED_AT in table.column_names else "timestamp"], float)
        numbers = {name: _column(table, *place) for name, place in columns.items()}
        views = [_images(folder, info, key, episode, table) for key in keys]
        for row, (time, images) in enumerate(zip(times.tolist(), zip(*views, strict=True), strict=True)):
            yield Sample(time, list(images), {name: values[row] for name, values in numbers.items()})


def _episodes(folder: Path, info: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what is known of each episode: where its rows and films are."""
    if files := sorted((folder / "meta/episodes").rglob("*.parquet")):
        tables = [pq.read_table(file) for file in files]
        names = [name for name in tables[0].column_names if not name.startswith("stats/")]
        episodes = [episode for table in tables for episode in table.select(names).to_pylist()]
        return sorted(episodes, key=lambda episode: episode["episode_index"])
    chunks = info["chunks_size"]  # v2 has a file for each episode, at a place that follows from its number
    return [{"episode_index": n, "episode_chunk": n // chunks} for n in range(info["total_episodes"])]


def _column(table: pa.Table, key: str, at: int) -> Sequence[float]:
    """Return one number of a feature in each row; nan for one that is missing."""
    values = [value[at] if isinstance(value, list) else value for value in table[key].to_pylist()]
    return np.array(values, float).tolist()


def _images(
    folder: Path, info: dict[str, Any], key: str, episode: dict[str, Any], table: pa.Table
) -> Iterator[np.ndarray]:
    """Yield the frame of a camera in each row of an episode: uint8 (rows, columns, 3), RGB. Raises RecordingError."""
    if info["features"][key]["dtype"] == "image":
        for image in table[key].to_pylist():
            if (pixels := decoded(image["bytes"])) is None:
                raise RecordingError(f"{key}: a damaged image in episode {episode['episode_index']}; copy it again")
            yield pixels
        return
    begin = f"videos/{key}/"
    where = {name.removeprefix(begin): value for name, value in episode.items() if name.startswith(begin)}
    path = folder / info["video_path"].format(video_key=key, **where, **episode)
    start, rate, row = where.get("from_timestamp", 0.0), info["fps"], 0
    with av.open(str(path.absolute())) as film:  # else http:… in the current folder would be an address, not a file
        stream = film.streams.video[0]
        before = max(0.0, start - REORDERED / rate)  # else HEVC's films begin at the key frame after it
        film.seek(int(before / stream.time_base), stream=stream)
        for frame in film.decode(stream):
            if frame.time > start + (row + 0.5) / rate:
                break  # or all frames that follow were other rows'
            if frame.time > start + (row - 0.5) / rate:
                yield frame.to_ndarray(format="rgb24")
                row += 1
                if row == len(table):
                    return
    raise RecordingError(f"{path}: has no frame for row {row} of episode {episode['episode_index']}; copy it again")
