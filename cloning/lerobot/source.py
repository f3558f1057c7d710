"""What a program that records drives gives: samples, which become a recording, and notes of what does not fit."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.files import folder_written_whole, write
from cloning.base.frame import FRAME
from cloning.recordings.format import CAMERAS, DRIVE_GAP, DRIVING_LOG, IMAGE_FOLDER, NUMBERS, time_stamp
from cloning.recordings.images import encode
from cloning.recordings.writer import log_bytes, start_of
from cloning.road.camera import CAMERA_OFFSETS
from cloning.road.warp import warp

JPEG_QUALITY = 95  # of images that were compressed before
ROUNDING = 1e-6  # of the steering at full lock
LATEST = 1e10  # s: a later time, after the year 2286, is none
UNDATED = 1e8  # s since 1970: an earlier time is no date, but counts from the source's beginning
MILLISECOND = 0.001  # s: two images with the same time stamp would have the same name
NOT_THERE = {
    "throttle": "no throttle: 0 is written; train with --throttle-threshold 0",
    "brake": "no brake: 0 is written",
    "speed": "no speed in mph: 0 is written; --robust and replays, which follow the car's path, can't do without it",
}
SIDES_MADE = (
    "only one camera: the left and right images are made from its images, as the simulator's side cameras would see a "
    "flat road if it were the simulator's centre camera"
)


@dataclass(frozen=True)
class Sample:
    """A moment of a drive."""

    time: float  # s; a drive that begins earlier than the one before it ended is moved behind it
    images: list[np.ndarray]  # uint8 (rows, columns, 3), RGB, of any size: centre, left, right, or the centre's alone
    # Steering, right positive, and what the source has of throttle, which brakes below 0, brake, and speed, mph.
    numbers: dict[str, float]


def write_recording(samples: Iterator[Sample], folder: Path, full_lock: float, notes: Counter[str]) -> int:
    """Write samples as a recording into a new folder; return the number of rows.

    full_lock: the samples' steering at the simulator's full lock of 25 degrees to the right; notes: is added to what
    does not fit, and how often. Raises RecordingError if the samples' steering is beyond it, or if there are none, and
    OSError, also if the folder exists; then nothing is written.
    """
    rows, shift, before, last = [], 0.0, -np.inf, -np.inf
    start: datetime | None = None  # the time 0
    with folder_written_whole(folder) as temporary:
        (temporary / IMAGE_FOLDER).mkdir()
        for sample in samples:
            for name in NUMBERS:
                if name not in sample.numbers:
                    notes[NOT_THERE[name]] += 1
            steering, throttle, brake, speed = (sample.numbers.get(name, 0.0) for name in NUMBERS)
            steering /= full_lock
            if not (np.isfinite([steering, throttle, brake, speed]).all() and abs(sample.time) < LATEST):
                notes["a row whose time or numbers are not finite is left out"] += 1
                continue
            if abs(steering) > 1 + ROUNDING:
                raise RecordingError(
                    f"steering {steering * full_lock:g} where {full_lock:g} is the full lock to the right: name the "
                    "value of 25 degrees to the right with --full-lock, below 0 if left is positive"
                )
            steering = max(-1.0, min(steering, 1.0))
            if throttle < 0:
                notes["throttle below 0 is written as brake"] += 1
                throttle, brake = 0, max(brake, -throttle)
            if max(throttle, brake) > 1:
                notes["throttle or brake above 1 is written as 1"] += 1
            time = sample.time + shift
            if time < before:
                shift += last + 2 * DRIVE_GAP - time
                time = last + 2 * DRIVE_GAP
            before, last = time, round(max(time, last + MILLISECOND), 6)  # else the sum falls short of a millisecond
            if start is None:  # others' images get other names where programs put several recordings into one folder
                start = datetime(1970, 1, 1) if last > UNDATED else start_of(0, sample.images[0].tobytes())
            stamp = time_stamp(start + timedelta(seconds=last))
            names = [f"{camera}_{stamp}.jpg" for camera in CAMERAS]
            for name, frame in zip(names, _three([fit(image, notes) for image in sample.images], notes), strict=True):
                (temporary / IMAGE_FOLDER / name).write_bytes(encode(frame, JPEG_QUALITY))
            rows.append((names, [np.float32(value) for value in (steering, min(throttle, 1), min(brake, 1), speed)]))
        if not rows:
            raise RecordingError("no usable row")
        write(temporary / DRIVING_LOG, log_bytes(folder, rows))
    return len(rows)


def chosen_camera(names: list[str], camera: str | None) -> str:
    """Return the camera that looks ahead: the one that is named, or the only one. Raises RecordingError."""
    chosen = [name for name in names if camera in (name, None)]
    if len(chosen) != 1:
        raise RecordingError(f"which camera looks ahead? Name it with --camera: {', '.join(names) or 'there is none'}")
    return chosen[0]


def decoded(image: bytes) -> np.ndarray | None:
    """Return an image file's pixels, uint8 (rows, columns, 3), RGB, or None if it is damaged."""
    if not image or (image.startswith(b"\xff\xd8") and b"\xff\xd9" not in image):  # its end is missing, or zeros
        return None
    try:
        return cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR_RGB)
    except cv2.error:  # of an image that is larger than OpenCV allows
        return None


def fit(image: np.ndarray, notes: Counter[str]) -> np.ndarray:
    """Return the middle of an image, as large as fits, at a frame's size: uint8 (160, 320, 3)."""
    rows, columns, _ = image.shape
    if (rows, columns) == FRAME[:2]:
        return image
    height, width = min(rows, max(1, columns * FRAME[0] // FRAME[1])), min(columns, rows * FRAME[1] // FRAME[0])
    notes[f"of images of {columns}x{rows} pixels the middle {width}x{height} are scaled to {FRAME[1]}x{FRAME[0]}"] += 1
    top, left = (rows - height) // 2, (columns - width) // 2
    middle = image[top : top + height, left : left + width]
    return cv2.resize(middle, FRAME[1::-1], interpolation=cv2.INTER_AREA if width > FRAME[1] else cv2.INTER_CUBIC)


def _three(frames: list[np.ndarray], notes: Counter[str]) -> list[np.ndarray]:
    """Return frames of the three cameras; those of the sides are made if there is only the centre's."""
    if len(frames) == len(CAMERAS):
        return frames
    notes[SIDES_MADE] += 1
    return [frames[0], *(warp(frames[0], CAMERA_OFFSETS[side], 0, 0)[0] for side in CAMERAS[1:])]
