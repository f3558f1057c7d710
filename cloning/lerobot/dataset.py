"""Write recordings as a data set in LeRobot's format v3; an episode is a drive without a pause.

| feature | what it holds |
|---|---|
| `observation.images.center`, `.left`, `.right` | the cameras' frames, 160 x 320, RGB: films of each, H.264 |
| `observation.state` | speed in mph, and in m/s, because LeRobot's policies fail with a state of one number |
| `action` | steering, -1..1 for -25..25 degrees, right positive; throttle and brake, 0..1 |
| `recorded_at` | seconds since 1970 by the recording computer's clock; `timestamp` counts frames of equal length |

The format: https://huggingface.co/docs/lerobot/lerobot-dataset-v3; read back with LeRobot 0.4.4.
"""

import io
import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from cloning.base.files import folder_written_whole, write
from cloning.base.film import FilmWriter, frame_rate
from cloning.base.frame import FRAME
from cloning.base.outputs import plural
from cloning.base.progress import progress_bar
from cloning.lerobot import TASK
from cloning.recordings.format import CAMERAS, DRIVE_GAP, SAMPLE_RATE
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording
from cloning.road.motion import MPH

FILMS = {f"observation.images.{camera}": camera for camera in CAMERAS}
STATE, ACTION, RECORDED_AT = "observation.state", "action", "recorded_at"
UNITS = {  # of each number, by its name
    STATE: {"speed": "mph", "speed in m/s": "m/s"},
    ACTION: {"steering": "-1..1 for -25..25 degrees, right positive", "throttle": "0..1", "brake": "0..1"},
    RECORDED_AT: {"recorded_at": "seconds since 1970 by the recording computer's clock"},
}
COUNTS = ("frame_index", "episode_index", "index", "task_index")
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
SAMPLED = 8  # every so many rows and columns of a frame count for the statistics
COUNTED = 5000  # frames at most, evenly chosen, as LeRobot does: more take 60 kB each
# LeRobot compares times in float32, to 0.0001 s: later in a film, it would find frames of some episodes at other times.
FILM_SECONDS = 1024
KEY_FRAMES = 15  # so that a frame anywhere in a film is soon decoded
FIRST_FILE = "chunk-000/file-000"
PATHS = {
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
ENVIRONMENT = '''"""The roads, for LeRobot's EnvHub, which finds this file in a model repository, not in a data set's.

It needs the project behavioral-cloning[gymnasium].
"""

from simulator.lerobot import make_env  # noqa: F401
'''
CARD = """---
tags: [LeRobot]
task_categories: [robotics]
configs: [{config_name: default, data_files: data/*/*.parquet}]
---
Drives in the Udacity simulator, or its stand-in, written by `python -m cloning.lerobot` of behavioral-cloning.

"""


def write_data_set(recordings: Sequence[Recording], folder: Path) -> str:
    """Write all rows of recordings, whose images are checked, into a new folder; return in words what it holds.

    Successive rows with the same centre image are written once. Raises OSError, also if the folder exists, and
    RecordingError if an image cannot be read; then nothing is written.
    """
    recordings = [recording.without_copies() for recording in recordings]
    times, speed = (np.concatenate([getattr(each, name) for each in recordings]) for name in ("time", "speed"))
    rate = round(frame_rate(times.tolist(), SAMPLE_RATE))
    breaks = [np.flatnonzero(np.diff(each.time) > DRIVE_GAP) + 1 for each in recordings]
    lengths = np.concatenate([np.diff([0, *at, len(each)]) for each, at in zip(recordings, breaks, strict=True)])
    starts = np.cumsum(lengths) - lengths
    index, rows = np.arange(len(times)), [(each, row) for each in recordings for row in range(len(each))]
    episode, begins = np.repeat(np.arange(len(lengths)), lengths), _film_begins(starts, lengths, rate)
    columns = {
        STATE: np.stack([speed, speed * np.float32(MPH)], axis=1),
        ACTION: np.concatenate([np.stack([getattr(each, name) for name in UNITS[ACTION]], 1) for each in recordings]),
        RECORDED_AT: times,
        "timestamp": ((index - starts[episode]) / rate).astype(np.float32),
        **dict(zip(COUNTS, (index - starts[episode], episode, index, 0 * index), strict=True)),
    }
    with folder_written_whole(folder) as temporary:
        values: dict[str, np.ndarray] = dict(columns)
        with progress_bar(len(FILMS) * len(times), "image", desc="writing films", leave=False) as bar:
            for key, camera in FILMS.items():
                sampled = []
                for number, (begin, end) in enumerate(pairwise([*dict.fromkeys(begins), len(times)])):
                    path = temporary / PATHS["video_path"].format(video_key=key, chunk_index=0, file_index=number)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    with FilmWriter(path, rate, key_frames=KEY_FRAMES) as film:
                        for at in range(begin, end):
                            recording, row = rows[at]
                            frame = read_frame(recording.path(row, CAMERAS.index(camera)))
                            film.add(frame, is_key=columns["frame_index"][at] == 0)
                            sampled.append(frame[::SAMPLED, ::SAMPLED].copy())
                            bar.update()
                values[key] = np.stack(sampled)
        _write_table(temporary / f"data/{FIRST_FILE}.parquet", _data(columns))
        _write_table(
            temporary / f"meta/episodes/{FIRST_FILE}.parquet", _episodes(values, starts, lengths, begins, rate)
        )
        _write_table(temporary / "meta/tasks.parquet", _tasks())
        statistics = {key: _statistics(value) for key, value in values.items()}
        write(temporary / "meta/stats.json", json.dumps(statistics, indent=1).encode())
        info = {
            **{"codebase_version": "v3.0", "robot_type": "udacity car"},
            **{"total_episodes": len(lengths), "total_frames": len(times), "total_tasks": 1},
            **{"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200},
            "fps": rate,
            "splits": {"train": f"0:{len(lengths)}"},
            **PATHS,
            "features": _features(rate),
        }
        write(temporary / "meta/info.json", json.dumps(info, indent=1).encode())
        write(temporary / "README.md", (CARD + (__doc__ or "").partition("\n\n")[2]).encode())
        write(temporary / "env.py", ENVIRONMENT.encode())
    return f"{plural(len(times), 'frame')} of 3 cameras in {plural(len(lengths), 'episode')}, {rate} a second"


def _film_begins(starts: np.ndarray, lengths: np.ndarray, rate: int) -> list[int]:
    """Return the row with which the film begins that has each episode; an episode that is too long has its own."""
    begins = list[int]()
    for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        goes_on = begins and start + length - begins[-1] <= FILM_SECONDS * rate
        begins.append(begins[-1] if goes_on else start)
    return begins


def _features(rate: int) -> dict[str, dict[str, Any]]:
    """Return what info.json says of each feature; rate: frames a second."""
    film = {
        **{"video.height": FRAME[0], "video.width": FRAME[1], "video.channels": FRAME[2], "video.fps": rate},
        **{"video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "has_audio": False},
    }
    films = {"dtype": "video", "shape": FRAME, "names": ["height", "width", "channels"], "info": film}
    numbers = {
        key: {
            "dtype": "float64" if key == RECORDED_AT else "float32",
            **{"shape": [len(units)], "names": list(units), "units": list(units.values())},
        }
        for key, units in UNITS.items()
    }
    counts = {key: {"dtype": "int64", "shape": [1], "names": None} for key in COUNTS}
    return {**dict.fromkeys(FILMS, films), **numbers, "timestamp": {**counts["index"], "dtype": "float32"}, **counts}


def _data(columns: dict[str, np.ndarray]) -> pa.Table:
    """Return the table of the rows; columns: (n,), but those of the state and the action (n, k)."""
    arrays = {key: pa.array(column.ravel()) for key, column in columns.items()}
    for key in (STATE, ACTION):
        arrays[key] = pa.FixedSizeListArray.from_arrays(arrays[key], len(UNITS[key]))
    return pa.table(arrays)


def _episodes(
    values: dict[str, np.ndarray], starts: np.ndarray, lengths: np.ndarray, begins: list[int], rate: int
) -> pa.Table:
    """Return the table of the episodes.

    values: of each feature in all rows; starts: first row of each episode; begins: of `_film_begins`.
    """
    zeros, ends, film = 0 * starts, starts + lengths, np.unique(begins, return_inverse=True)[1]
    columns: dict[str, Any] = {
        "episode_index": np.arange(len(starts)),
        "tasks": [[TASK]] * len(starts),
        "length": lengths,
        **{"dataset_from_index": starts, "dataset_to_index": ends},
        **{f"{name}/{kind}_index": zeros for name in ("data", "meta/episodes") for kind in ("chunk", "file")},
    }
    for key in FILMS:
        columns |= {f"videos/{key}/chunk_index": zeros, f"videos/{key}/file_index": film}
        columns |= {
            f"videos/{key}/{end}_timestamp": (each - begins) / rate for end, each in (("from", starts), ("to", ends))
        }
    for key, value in values.items():
        episodes = [_statistics(value[start:end]) for start, end in zip(starts, ends, strict=True)]
        columns |= {f"stats/{key}/{name}": [each[name] for each in episodes] for name in episodes[0]}
    return pa.table(columns)


def _statistics(values: np.ndarray) -> dict[str, list]:
    """Return the statistics that LeRobot normalizes by; values: numbers (n,) or (n, k), or images, uint8 (n, …, 3).

    Those of images are of 0..1, and have the shape (3, 1, 1).
    """
    is_image, count = values.ndim == 4, len(values)
    if is_image:
        values = values[:: -(-count // COUNTED)]
    flat = values.reshape(-1, values.shape[-1]) / (255 if is_image else 1) if values.ndim > 1 else values[:, None]
    flat = flat.astype(np.float64)
    found = {"min": flat.min(0), "max": flat.max(0), "mean": flat.mean(0), "std": flat.std(0)}
    found |= dict(zip(QUANTILES, np.quantile(flat, list(QUANTILES.values()), axis=0), strict=True))
    shape = (-1, 1, 1) if is_image else (-1,)
    return {name: value.reshape(shape).tolist() for name, value in found.items()} | {"count": [count]}


def _tasks() -> pa.Table:
    """Return the table of the only task, which pandas reads with the task's text as the index."""
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.2.3"}
    return pa.table({"task_index": [0], "task": [TASK]}).replace_schema_metadata({"pandas": json.dumps(pandas)})


def _write_table(path: Path, table: pa.Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    file = io.BytesIO()
    pq.write_table(table, file)
    write(path, file.getvalue())
