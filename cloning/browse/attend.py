"""Compute what models look at on frames, as pictures to lay over them; `attention.py` asks for them over a pipe."""

import os
import pickle
import signal
import sys
import threading
from functools import lru_cache
from pathlib import Path

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which then ends this process

import cv2
import numpy as np
import torch

from cloning.base.errors import ModelError, UserError, message_of
from cloning.network.attention import visual_backprop
from cloning.network.network import Network, load_model
from cloning.recordings.images import decode
from cloning.road.overlay import MAGENTA, opacity

IDLE = 120.0  # s without a question after which the process ends, and frees its memory


def main() -> None:
    """Answer each JPEG and model's file with a message and a PNG, until stdin ends, or for IDLE seconds."""
    if hasattr(os, "nice"):
        os.nice(10)  # the page, and whatever else the user does, goes first
    torch.set_num_threads(1)
    while True:
        idle = threading.Timer(IDLE, os._exit, [0])
        idle.daemon = True
        idle.start()
        try:
            jpeg, model = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        idle.cancel()
        message, png = "", b""
        try:
            png = picture(jpeg, model)
        except (UserError, OSError) as error:
            message = message_of(error)
        except ValueError as error:
            message = f"the picture is unusable: {error}"
        pickle.dump((message, png), sys.stdout.buffer)
        sys.stdout.buffer.flush()


def picture(jpeg: bytes, model: str) -> bytes:
    """Return a PNG of a frame's size, MAGENTA, as opaque as `opacity` says.

    Raises ModelError, OSError, and ValueError if the JPEG is unusable.
    """
    frame = decode(jpeg)
    try:
        _, mask = visual_backprop(network(model, Path(model).stat().st_mtime_ns), frame)
    except ArithmeticError as error:
        raise ModelError(f"{model}: {error}; train the model again") from None
    shown = np.empty((*frame.shape[:2], 4), np.uint8)
    shown[..., :3] = MAGENTA[::-1]  # BGR, as OpenCV writes it
    shown[..., 3] = np.round(255 * opacity(mask))
    return cv2.imencode(".png", shown, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


@lru_cache(maxsize=8)
def network(model: str, changed: int) -> Network:
    """Return a model's network; changed: time of change of its file, so that a new one is read. Raises ModelError."""
    return load_model(model)


if __name__ == "__main__":
    main()
