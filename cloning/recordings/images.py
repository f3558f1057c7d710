"""Frames: decoded alike in training and in driving, and a recording's `IMG/` checked before it is trained on."""

import struct
from pathlib import Path

import cv2
import numpy as np

from cloning.errors import RecordingError
from cloning.recordings.format import FRAME


def jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Rows and columns of a JPEG from its header, without decoding it.

    Raises ValueError for what is no JPEG, or one that was cut short (no end marker after the scan's start).
    """
    if not jpeg:
        raise ValueError("empty")
    if jpeg[:2] != b"\xff\xd8":
        raise ValueError("not a JPEG")
    size, at = None, 2
    while at + 9 < len(jpeg) and jpeg[at] == 0xFF:
        marker, length = jpeg[at + 1], struct.unpack_from(">H", jpeg, at + 2)[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            size = struct.unpack_from(">HH", jpeg, at + 5)
        if marker == 0xDA:  # start of scan: entropy-coded to the end marker, which cannot occur inside it
            if size and jpeg.rfind(b"\xff\xd9", at) > 0:
                return size
            break
        at += 2 + length
    raise ValueError("cut short")


def decode(jpeg: bytes) -> np.ndarray:
    """A recorded or received JPEG as the network sees it, in training and in driving alike: uint8 (160, 320, 3), RGB.

    Raises ValueError, before decoding, for what is no whole JPEG of 160 rows and 320 columns.
    """
    rows, columns = jpeg_size(jpeg)
    if (rows, columns) != FRAME[:2]:
        raise ValueError(f"{columns}x{rows} pixels where {FRAME[1]}x{FRAME[0]} are expected")
    frame = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    if frame is None:
        raise ValueError("damaged")
    return frame


def read_frame(path: Path) -> np.ndarray:
    """Read and decode a recorded image: uint8 (160, 320, 3), RGB.

    Raises OSError for a file that can't be read, RecordingError for one that isn't a whole JPEG of a frame's size.
    """
    try:
        return decode(path.read_bytes())
    except ValueError as error:
        raise RecordingError(f"{path}: {error}; copy it again, or delete its row from the log") from error
