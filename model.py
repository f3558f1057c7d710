"""Train NVIDIA's network to steer from recordings of the Udacity simulator.

    python model.py                                 # every folder with a driving_log.csv under data/
    python model.py data/lake-ccw data/lake-cw      # or these
"""

import io
import os
import struct
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn

FRAME = (160, 320, 3)  # rows, columns, RGB: what the simulator records and sends
FORMAT, VERSION = "behavioral-cloning", 1  # of model.pt


class ModelError(Exception):
    """A model file that cannot be used; the message names the file and the remedy."""


# ---------------------------------------------------------------------------------------------------------------------
# Frames


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


# ---------------------------------------------------------------------------------------------------------------------
# Network


class Network(nn.Module):
    """NVIDIA's network (arXiv 1604.07316) as the report uses it: 559,419 parameters.

    forward: frames uint8 (N, 160, 320, 3), RGB, or already cropped (N, 75, 320, 3) -> steering float32 (N,),
    where -1..1 is the simulator's -25°..25°, positive to the right.
    """

    def __init__(self, crop=(60, 25), scale=127.5, offset=1.0):
        """crop: rows cut off the top and the bottom; a pixel value x enters as x / scale - offset."""
        super().__init__()
        self.crop, self.scale, self.offset = tuple(crop), scale, offset
        self.convolutions = nn.ModuleList(
            nn.Conv2d(into, out, kernel, stride)
            for into, out, kernel, stride in
            [(3, 24, 5, 2), (24, 36, 5, 2), (36, 48, 5, 2), (48, 64, 3, 1), (64, 64, 3, 1)]
        )
        self.dropout = nn.Dropout(0.5)
        self.dense = nn.ModuleList(nn.Linear(into, out) for into, out in [(4224, 100), (100, 50), (50, 10), (10, 1)])

    def forward(self, frames):
        top, bottom = self.crop
        if frames.shape[1] == FRAME[0]:
            frames = frames[:, top:FRAME[0] - bottom]
        x = frames.permute(0, 3, 1, 2).float() / self.scale - self.offset
        for convolution in self.convolutions:
            x = nn.functional.elu(convolution(x))
        x = self.dropout(x.flatten(1))
        for layer in self.dense[:-1]:
            x = nn.functional.elu(layer(x))
        return self.dense[-1](x).squeeze(1)


# ---------------------------------------------------------------------------------------------------------------------
# model.pt


def write(path: Path, data: bytes) -> None:
    """Write a file beside its place and rename it there, so that a kill leaves the old file or the new one, whole."""
    handle, beside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except BaseException:
        os.unlink(beside)
        raise


def save_model(path: Path, network: Network, **more) -> None:
    """Write a model file: weights, what driving needs to use them, and `more` (plain values and tensors)."""
    buffer = io.BytesIO()
    torch.save({
        "format": FORMAT, "version": VERSION, "network": network.state_dict(),
        "recipe": {"frame": FRAME, "colour": "RGB", "crop": network.crop, "scale": network.scale,
                   "offset": network.offset},
        "versions": {"torch": torch.__version__, "opencv": cv2.__version__, "numpy": np.__version__}, **more,
    }, buffer)
    write(Path(path), buffer.getvalue())


def load_checkpoint(path) -> dict:
    """The contents of a model file, read with weights_only=True. Raises ModelError."""
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file; `python model.py` trains one") from None
    except Exception as error:
        raise ModelError(f"{path}: not a model of this project, or damaged ({type(error).__name__})") from error
    if not isinstance(saved, dict) or saved.get("format") != FORMAT:
        raise ModelError(f"{path}: not a model of this project; `python model.py` trains one")
    if saved.get("version") != VERSION:
        raise ModelError(f"{path}: version {saved.get('version')} of the model file where this program reads "
                         f"version {VERSION}; train it again with `python model.py`")
    return saved


def load_model(path, device="cpu") -> Network:
    """The network of a model file, ready to drive (evaluation mode). Raises ModelError."""
    saved = load_checkpoint(path)
    recipe = saved["recipe"]
    network = Network(recipe["crop"], recipe["scale"], recipe["offset"])
    try:
        network.load_state_dict(saved["network"])
    except RuntimeError as error:
        raise ModelError(f"{path}: its weights do not fit the network ({error})") from None
    return network.to(device).eval()
