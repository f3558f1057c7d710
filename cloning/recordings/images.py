"""Encode and decode the JPEGs of frames, in the same way for training, driving and replaying."""

import struct
from pathlib import Path

import cv2
import numpy as np

from cloning.errors import RecordingError
from cloning.recordings.format import FRAME


def jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Return rows and columns of a JPEG from its header, without decoding it.

    Raises ValueError if it is not a JPEG, or was cut short (no end marker after the start of the scan).
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
    """Decode the JPEG of a recorded or received frame: uint8 (160, 320, 3), RGB.

    Raises ValueError if it is not a whole JPEG of 160 rows and 320 columns; this is checked before decoding.
    """
    rows, columns = jpeg_size(jpeg)
    if (rows, columns) != FRAME[:2]:
        raise ValueError(f"{columns}x{rows} pixels where {FRAME[1]}x{FRAME[0]} are expected")
    frame = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    if frame is None:
        raise ValueError("damaged")
    return frame


def encode(frame: np.ndarray, quality: int) -> bytes:
    """Encode a frame, uint8 (rows, columns, 3), RGB, as JPEG; quality: 0..100."""
    bgr = cv2.cvtColor(frame, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def read_frame(path: Path) -> np.ndarray:
    """Read and decode a recorded image: uint8 (160, 320, 3), RGB.

    Raises OSError if the file can't be read, RecordingError if it isn't a whole JPEG of a frame's size.
    """
    try:
        return decode(path.read_bytes())
    except ValueError as error:
        raise RecordingError(f"{path}: {error}; copy it again, or delete its row from the log") from error
