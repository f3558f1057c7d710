"""A tiny rendered recording in the simulator's own format."""

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cloning.base.frame import FRAME
from cloning.recordings.format import NUMBERS
from cloning.recordings.log import CheckedRecording
from cloning.road.camera import CAMERA_HEIGHT, CAMERA_MATRIX, FAR_SLOPE
from cloning.road.warp import ground_mask

GROUND = np.array([(120, 130, 60), (110, 110, 105), (210, 180, 60)], np.uint8)  # beside the road, on it, its lines


def render_frame(bend: float, offset: float, rng: np.random.Generator) -> np.ndarray:
    """A grey road to the horizon, bent by -1..1 and seen from `offset` metres right of its centre: uint8 RGB."""
    frame = np.empty((160, 320, 3), np.uint8)
    frame[:60] = (90, 140, 210)
    rows = np.arange(60, 160)
    far = (160 - rows) / 100
    middle = 160 + 120 * bend * far**2 - offset * (rows - 60) * 1.2
    half = 3.5 * (rows - 60) * 1.2 + 4
    left, right = ((middle + side * half).astype(int)[:, None] for side in (-1, 1))
    columns = np.arange(320)
    ground = ((left <= columns) & (columns < right)).astype(np.uint8)
    for edge in (left, right):
        ground[(edge - 3 <= columns) & (columns < edge + 3)] = 2
    frame[60:] = GROUND[ground]
    return np.clip(frame + rng.integers(-10, 11, frame.shape, np.int8), 0, 255).astype(np.uint8)


def plane(right: float, forward: float, heading: float, mirrored: bool = False) -> np.ndarray:
    """A rendered frame of a smoothly painted plane under a plain sky: uint8 (160, 320, 3)."""
    columns, rows = np.meshgrid(np.arange(FRAME[1]), np.arange(FRAME[0]))
    directions = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(CAMERA_MATRIX).T
    down = np.maximum(directions[..., 1], FAR_SLOPE)
    across, ahead = CAMERA_HEIGHT * directions[..., 0] / down, CAMERA_HEIGHT * directions[..., 2] / down
    if mirrored:
        across = -across
    x = right + across * np.cos(heading) + ahead * np.sin(heading)
    z = forward - across * np.sin(heading) + ahead * np.cos(heading)
    painted = np.stack([127 + 100 * np.sin(x / a + z / b) for a, b in ((1.1, 9.0), (2.3, -7.0), (-1.7, 12.0))], axis=-1)
    return np.where(ground_mask()[..., None], painted, 127).round().astype(np.uint8)


def film_of(path: Path) -> tuple[float, list[np.ndarray]]:
    """A film's frames a second, and its frames: uint8, BGR; decoded by OpenCV's own FFmpeg."""
    capture, frames = cv2.VideoCapture(str(path)), []
    while (read := capture.read())[0]:
        frames.append(read[1])
    return capture.get(cv2.CAP_PROP_FPS), frames


def render_recording(folder: Path, rows: int = 60, seed: int = 0, prefix: str = "/Users/driver/data/IMG/") -> Path:
    """A folder as the simulator records it: no header, absolute paths, 15 rows a second, throttle 0 in every tenth."""
    rng = np.random.default_rng(seed)
    (folder / "IMG").mkdir(parents=True)
    clock, lines = datetime(2018, 7, 16, 17, 11, 43) + timedelta(days=seed), []
    for row in range(rows):
        clock += timedelta(milliseconds=67)
        stamp = clock.strftime("%Y_%m_%d_%H_%M_%S_%f")[:-3]
        bend = float(np.sin(row / 5))
        names = []
        for camera, offset in (("center", 0), ("left", -0.8), ("right", 0.8)):
            names.append(f"{camera}_{stamp}.jpg")
            frame = render_frame(bend, offset, rng)
            cv2.imwrite(str(folder / "IMG" / names[-1]), frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 75])
        throttle = 0 if row % 10 == 9 else 1
        lines.append(",".join([prefix + name for name in names] + [f"{0.4 * bend:.6g}", str(throttle), "0", "30.19"]))
    (folder / "driving_log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def without_files(
    n: int, name: str = "lake", seconds: float = 0.0714, first: float = 0, **columns: float
) -> CheckedRecording:
    """n rows of a recording that has no files; columns: steering and others' values, else 0."""
    more: dict[str, Any] = {column: np.full(n, columns.get(column, 0), np.float32) for column in NUMBERS}
    time, lines = first + np.arange(n) * seconds, np.arange(1, n + 1, dtype=np.int32)
    images = np.tile(np.arange(n, dtype=np.int32)[:, None], 3)  # each row has images of its own
    more |= {"time": time, "lines": lines, "rows_read": n, "digests": np.arange(n, dtype=np.uint64)}
    return CheckedRecording(Path(name), np.array([], "S9"), images, **more)
