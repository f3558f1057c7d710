"""Encode, read and decode the JPEGs of frames, in the same way for training, driving, filming and replaying."""

import os
import re
import stat
import struct
from pathlib import Path

import cv2
import numpy as np

from cloning.base.errors import RecordingError
from cloning.base.frame import FRAME
from cloning.recordings.format import LFS_POINTER, NOT_PULLED

RULES = 3  # of what a usable image is: counted up when they change, because `check_images` keeps its results
MAX_BYTES = 1 << 20  # of a frame's JPEG; noise at quality 100 takes a fifth of it
MAX_SEGMENTS = 100  # a camera's JPEG has 10
MAX_SCANS = 20  # a progressive JPEG usually has 10; each one may take as long as the whole frame

BLOCK_ROWS = 16  # of a frame that `encode` compresses together: colour has half the resolution, in blocks of 8 x 8
FRAME_HEADERS = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive; all with Huffman codes
SCAN_HEADER = 0xDA
OTHER_SEGMENTS = {0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0)}  # tables, restart interval, comment, application data
REMEDY = "put the right JPEG in its place, or delete the row"  # for an image that is missing or unusable
OTHER_KINDS = {b"\x89PNG": " but a PNG", LFS_POINTER: f" but {NOT_PULLED}"}
EMPTIED = bytes(512)  # a disk's sector after a power failure; a scan of the simulator's has 6 zeros at most
MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7]")  # the first one ends the scan; restart markers do not


def nonblocking(path: str, flags: int) -> int:
    """Open a file for `open`, without waiting if it is a named pipe that has no writer; Windows has none."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Return rows and columns of a whole colour JPEG from its markers, without decoding it.

    Where the markers leave room for interpretation, decoders disagree, and a huge frame can be hidden from all but one
    of them. So JPEGs are accepted only as encoders write them: segment follows segment without a gap to the end marker,
    with one frame header, 8 bits, three channels and few scans. Raises ValueError with the reason.
    """
    if not jpeg:
        raise ValueError("empty")
    if jpeg[:3] != b"\xff\xd8\xff":
        kind = next((kind for start, kind in OTHER_KINDS.items() if jpeg.startswith(start)), "")
        raise ValueError(f"not a JPEG{kind}")
    if len(jpeg) > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES} bytes")
    size, segments, scans, at = None, 0, 0, 2
    while jpeg[at : at + 2] != b"\xff\xd9":
        if at + 4 > len(jpeg):
            raise ValueError("cut short")
        start, marker, length = struct.unpack_from(">BBH", jpeg, at)
        is_frame_header = marker in FRAME_HEADERS and size is None and length >= 8
        is_scan_header = marker == SCAN_HEADER and scans < MAX_SCANS
        segments += 1
        if segments > MAX_SEGMENTS:
            raise ValueError(f"not a plain JPEG: more than {MAX_SEGMENTS} segments")
        if start != 0xFF or length < 2 or not (is_frame_header or is_scan_header or marker in OTHER_SEGMENTS):
            raise ValueError(f"not a plain JPEG: bytes {start:02X} {marker:02X} at {at}")
        end = at + 2 + length
        if end > len(jpeg):
            raise ValueError("cut short")
        if is_frame_header:
            bits, rows, columns, channels = struct.unpack_from(">BHHB", jpeg, at + 4)
            if (bits, channels) != (8, FRAME[2]):
                raise ValueError(f"{channels} channels of {bits} bits where {FRAME[2]} of 8 are expected")
            size = rows, columns
        if is_scan_header:
            scans += 1
            following = MARKER_IN_SCAN.search(jpeg, end)
            if not following:
                raise ValueError("cut short")
            end = following.start()
            if jpeg.find(EMPTIED, at, end) >= 0:
                raise ValueError("damaged: zeros in the middle of it")
        at = end
    if size is None or not scans:
        raise ValueError("no picture in it")
    return size


def decode(jpeg: bytes) -> np.ndarray:
    """Decode the JPEG of a recorded or received frame: uint8 (160, 320, 3), RGB.

    The pixels are as the camera wrote them: an orientation in Exif data is ignored, and greyscale and CMYK are refused.
    Raises ValueError if it is not a whole colour JPEG of 160 rows and 320 columns; this is checked before decoding.
    """
    rows, columns = jpeg_size(jpeg)
    if (rows, columns) != FRAME[:2]:
        raise ValueError(f"{columns}x{rows} pixels where {FRAME[1]}x{FRAME[0]} are expected")
    frame = pixels(jpeg)
    if frame.shape != FRAME or frame.dtype != np.uint8:
        raise ValueError("damaged")
    return frame


def pixels(jpeg: bytes) -> np.ndarray:
    """Return the pixels of a JPEG of any size: uint8 (rows, columns, 3), RGB. Raises ValueError if it is damaged."""
    try:
        pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ValueError("damaged") from error
    if pixels is None:
        raise ValueError("damaged")
    return pixels


def encode(frame: np.ndarray, quality: int) -> bytes:
    """Encode a frame, uint8 (rows, columns, 3), RGB, as JPEG with colour at half the resolution; quality: 0..100."""
    options = cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, cv2.IMWRITE_JPEG_QUALITY, quality
    return cv2.imencode(".jpg", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR), options)[1].tobytes()


def compressed_rows(rows: slice) -> slice:
    """Return the rows of a frame on whose compression these rows of it depend: theirs, and whole blocks around them.

    A decoder interpolates colours between a row and its neighbours, so these count as well.
    """
    first, end = max(rows.start - 1, 0), min(rows.stop + 1, FRAME[0])
    return slice(first - first % BLOCK_ROWS, end + -end % BLOCK_ROWS)


def compress(around: np.ndarray, rows: slice, quality: int) -> np.ndarray:
    """Return rows of a frame as they are after `encode` and `decode` of the whole frame, but sooner.

    around: the frame's `compressed_rows(rows)`, uint8 (m, 320, 3), RGB; quality: 0..100. Returns uint8 (k, 320, 3).
    """
    first = compressed_rows(rows).start
    return pixels(encode(around, quality))[rows.start - first : rows.stop - first]


def read_jpeg(path: Path) -> bytes:
    """Return the bytes of an image file, or its first ones if it is larger than any frame's.

    Raises ValueError with the reason if it cannot be read, or is not a regular file: a pipe would never end.
    """
    try:
        with open(path, "rb", buffering=0, opener=nonblocking) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise ValueError("not a regular file")
            return file.read(min(status.st_size, MAX_BYTES) + 1)
    except OSError as error:
        raise ValueError(error.strerror or str(error)) from error


def read_image(path: Path, remedy: str = REMEDY) -> tuple[bytes, np.ndarray]:
    """Return the bytes of a recorded image, and its frame: uint8 (160, 320, 3), RGB.

    Raises RecordingError, with the remedy, if the file cannot be read, or is not a whole JPEG of a frame's size.
    """
    try:
        jpeg = read_jpeg(path)
        return jpeg, decode(jpeg)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}; {remedy}") from error


def read_frame(path: Path, remedy: str = REMEDY) -> np.ndarray:
    """Read and decode a recorded image: uint8 (160, 320, 3), RGB. Raises RecordingError; see `read_image`."""
    return read_image(path, remedy)[1]
