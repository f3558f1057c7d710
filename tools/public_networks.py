"""Rebuild other people's public networks for the leaderboard: train them as they did, all on the same recordings.

    python -m tools.public_networks data/lake-ccw data/lake-cw data/jungle      # some 20 minutes on 2 cores
    python -m simulator benchmark public/naokishibuya.onnx --quick

PUBLISHED names each repository. Layers, preprocessing, augmentation and training have the figures that were read there;
neither code nor weights were copied. Each network is written to public/ as NAME.onnx, with the NAME.json by which the
benchmark prepares frames; here, the same function prepares them for the training.

What is different: rows are drawn at random in place of shuffled passes over all; a brightened pixel stays at 255, where
theirs overflows; and commaai, made for real roads, is trained for 10 of its 200 epochs.
"""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import nn

from cloning.base import program
from cloning.base.arguments import command_line
from cloning.base.cores import threads
from cloning.base.errors import RecordingError
from cloning.base.files import written_whole
from cloning.base.frame import FRAME
from cloning.base.outputs import claimed, write_json
from cloning.base.progress import progress_bar
from cloning.network.compute import choose_precision, in_precision
from cloning.network.export import onnx_program
from cloning.recordings.check import check_images
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording, find_folders, print_findings, read_recording
from simulator.driving import preprocessing

CPU = torch.device("cpu")
Rows = Sequence[tuple[Recording, int]]


class Published(NamedTuple):
    """A public network, and how it is trained."""

    source: str  # repository @ commit, and its licence
    layers: Callable[[], nn.Sequential]  # makes it; it takes float32 (n, 3, *size)
    size: tuple[int, int]  # rows and columns
    about: dict[str, Any]  # what makes this of a frame: see `simulator/driving.py`
    learning_rate: float  # of Adam
    batch: int  # images
    samples: int  # images in an epoch
    epochs: int = 10
    held_out: float = 0.0  # share of the rows whose loss chooses the epoch that is kept; 0: the last one is
    augmented: float = 1.0  # share of the images that are changed as follows; others are centre images as they are
    # Steering added to the label of left images, subtracted from that of right ones; 0: only centre ones.
    side: float = 0.0
    flip: float = 0.0
    # By so many pixels to the sides, and up or down, images are moved at most; steering for a pixel sideways.
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # By so many pixels to the sides the middle row is moved at most, while the last one stays; steering for a pixel.
    shear: tuple[float, float] = (0.0, 0.0)
    brightness: float = 0.0  # how far the factor of the brightness is from 1 at most
    border: int = cv2.BORDER_CONSTANT  # OpenCV's, what comes in at the sides


# ----------------------------------------------------------------------------------------------------------------------
# The networks. Layers with Keras' padding "same" get its zeros, of which the end has one more where they are odd


def naokishibuya() -> nn.Sequential:
    """NVIDIA's network as most people rebuild it, 252,219 parameters; SelfOracle's (ICSE 2020, MIT) is made like it."""
    sizes = ((3, 24, 5, 2), (24, 36, 5, 2), (36, 48, 5, 2), (48, 64, 3, 1), (64, 64, 3, 1))
    convolutions = [layer for size in sizes for layer in (nn.Conv2d(*size), nn.ELU())]
    dense = [nn.Linear(1152, 100), nn.ELU(), nn.Linear(100, 50), nn.ELU(), nn.Linear(50, 10), nn.ELU()]
    return nn.Sequential(*convolutions, nn.Dropout(0.5), nn.Flatten(), *dense, nn.Linear(10, 1))


def commaai() -> nn.Sequential:
    """comma.ai's network, which takes the whole frame: 6,621,809 parameters."""
    convolutions = [nn.Conv2d(3, 16, 8, 4, padding=2), nn.ELU()]
    convolutions += [nn.ZeroPad2d((1, 2, 1, 2)), nn.Conv2d(16, 32, 5, 2), nn.ELU()]
    convolutions += [nn.ZeroPad2d((1, 2, 1, 2)), nn.Conv2d(32, 64, 5, 2)]
    dense = [nn.Dropout(0.2), nn.ELU(), nn.Linear(12800, 512), nn.Dropout(0.5), nn.ELU(), nn.Linear(512, 1)]
    return nn.Sequential(*convolutions, nn.Flatten(), *dense)


def ksakmann() -> nn.Sequential:
    """Large kernels and strides, and no pooling: 416,481 parameters."""
    convolutions = [nn.Conv2d(3, 32, 8, 4, padding=2), nn.ReLU(), nn.Conv2d(32, 64, 8, 4, padding=2), nn.ReLU()]
    convolutions += [nn.Conv2d(64, 128, 4, 2, padding=1), nn.ReLU()]
    convolutions += [nn.ZeroPad2d((0, 1, 0, 1)), nn.Conv2d(128, 128, 2), nn.ReLU()]
    dense = [nn.Dropout(0.5), nn.Linear(512, 128), nn.ReLU(), nn.Dropout(0.5), nn.Linear(128, 128), nn.Linear(128, 1)]
    return nn.Sequential(*convolutions, nn.Flatten(), *dense)


class Saturation(nn.Module):
    """Leaves S of HSV."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return (n, 1, rows, columns) of images (n, 3, rows, columns)."""
        return images[:, 1:2]


def xslittlegrass() -> nn.Sequential:
    """A tiny network: 63 parameters."""
    convolution = [Saturation(), nn.Conv2d(1, 2, 3), nn.ReLU(), nn.MaxPool2d(4), nn.Dropout(0.25)]
    return nn.Sequential(*convolution, nn.Flatten(), nn.Linear(42, 1))


PUBLISHED = {
    "naokishibuya": Published(
        "naokishibuya/car-behavioral-cloning @ 0cb1f7d, no licence found",
        naokishibuya,
        (66, 200),
        {"crop": [60, 25], "colour": "YUV", "range": [-1, 1]},
        learning_rate=1e-4,
        batch=40,
        samples=20_000,
        held_out=0.2,
        augmented=0.6,
        side=0.2,
        flip=0.5,
        shift=(50, 5, 0.002),
        brightness=0.2,
    ),
    "commaai": Published(
        "commaai/research @ 2a80c9b, BSD 3-clause",
        commaai,
        FRAME[:2],
        {"range": [-1, 1]},
        learning_rate=1e-3,
        batch=64,
        samples=10_000,
    ),
    "ksakmann": Published(
        "ksakmann/CarND-BehavioralCloning @ 26caf5b, no licence found",
        ksakmann,
        (64, 64),
        {"crop": [60, 24, 20, 20], "range": [-1, 1]},
        learning_rate=1e-4,
        batch=200,
        samples=20_000,
        flip=0.5,
        shift=(20, 2, 1 / 120),
        shear=(80, np.degrees(1 / 80) / 25 / 6),
        brightness=0.2,
        border=cv2.BORDER_REPLICATE,
    ),
    "xslittlegrass": Published(
        "xslittlegrass/CarND-Behavioral-Cloning @ c235b40, no licence found",
        xslittlegrass,
        (16, 32),
        {"colour": "HSV", "range": [-1, 1]},
        learning_rate=1e-3,
        batch=128,
        samples=28_000,  # nine tenths of the three images of 5,206 rows, and of their mirror images
        side=0.3,
        flip=0.5,
    ),
}

# ----------------------------------------------------------------------------------------------------------------------
# Training


def augment(frame: np.ndarray, steering: float, how: Published, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return a frame, uint8 (160, 320, 3), RGB, changed at random, and the steering that it then asks for."""
    if rng.random() < how.flip:
        frame, steering = np.ascontiguousarray(frame[:, ::-1]), -steering
    right, down, lean = rng.uniform(-1, 1, 3) * (*how.shift[:2], how.shear[0])
    if right or lean:
        middle = FRAME[0] / 2
        matrix = np.array([[1, -lean / middle, 2 * lean + right], [0, 1, down]])
        frame = cv2.warpAffine(frame, matrix, FRAME[1::-1], borderMode=how.border)
        steering += right * how.shift[2] + lean * how.shear[1]
    if how.brightness:  # all colours times a factor: what their factor of the HSV value does
        frame = cv2.convertScaleAbs(frame, alpha=rng.uniform(1 - how.brightness, 1 + how.brightness))
    return frame, steering


def train(how: Published, about: Path, recordings: Sequence[Recording]) -> nn.Sequential:
    """Return a network that was trained on recordings; about: the file with `how.about`. Raises RecordingError."""
    torch.manual_seed(0)
    network: nn.Sequential = how.layers().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    prepare = preprocessing(about, [1, 3, *how.size], whole=False)
    for layer in network:
        if isinstance(layer, (nn.Conv2d, nn.Linear)) and layer.bias is not None:  # begins as Keras does
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    rows = [(recording, row) for recording in recordings for row in range(len(recording))]
    np.random.default_rng(0).shuffle(rows)
    held_out = rows[: round(how.held_out * len(rows))]
    rows = rows[len(held_out) :]

    def example(recording: Recording, row: int, rng: np.random.Generator | None) -> tuple[np.ndarray, float]:
        steering = float(recording.steering[row])
        if rng is None or rng.random() >= how.augmented:
            return prepare(read_frame(recording.path(row)))[0], steering
        camera = int(rng.integers(3)) if how.side else 0
        steering += (0.0, how.side, -how.side)[camera]
        frame, steering = augment(read_frame(recording.path(row, camera)), steering, how, rng)
        return prepare(frame)[0], steering

    def batch(number: int) -> tuple[torch.Tensor, torch.Tensor]:
        rng = np.random.default_rng([1, number])
        chosen = [rows[i] for i in rng.integers(len(rows), size=how.batch)]
        return stacked([example(recording, row, rng) for recording, row in chosen])

    def loss_of(some: Rows) -> float:
        images, labels = stacked([example(recording, row, None) for recording, row in some])
        return float(nn.functional.mse_loss(network(images)[:, 0], labels)) * len(some)

    optimizer, steps = torch.optim.Adam(network.parameters(), how.learning_rate, eps=1e-8), how.samples // how.batch
    best, kept, precision, ahead = np.inf, network, choose_precision(CPU), threads()
    with progress_bar(steps * how.epochs, "batch", desc=how.layers.__name__) as bar, ThreadPoolExecutor(ahead) as pool:
        following = deque(pool.submit(batch, step) for step in range(ahead))
        for epoch in range(how.epochs):
            network.train()
            for step in range(epoch * steps, (epoch + 1) * steps):
                images, labels = following.popleft().result()
                following.append(pool.submit(batch, step + ahead))
                with in_precision(precision, CPU):
                    found = network(images)[:, 0]
                loss = nn.functional.mse_loss(found.float(), labels)
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                bar.update()
            network.eval()
            with torch.inference_mode():
                lost = sum(loss_of(held_out[i : i + how.batch]) for i in range(0, len(held_out), how.batch))
            if lost < best or not held_out:
                best, kept = lost, deepcopy(network)
    return kept


def stacked(examples: Sequence[tuple[np.ndarray, float]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Return images, float32 (n, 3, rows, columns), and labels, float32 (n,)."""
    images, labels = zip(*examples, strict=True)
    pixels = torch.from_numpy(np.stack(images)).contiguous(memory_format=torch.channels_last)
    return pixels, torch.tensor(labels, dtype=torch.float32)


def save(network: nn.Sequential, how: Published, file: Path) -> None:
    """Write a network as an ONNX file. Raises OSError."""
    with written_whole(file) as temporary:
        onnx_program(network, torch.zeros(1, 3, *how.size)).save(temporary)


def main() -> int:
    """Rebuild the networks; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.public_networks", __doc__)
    add = parser.add_argument
    add("recordings", nargs="+", help="folders of recordings")
    add("--networks", nargs="+", choices=PUBLISHED, default=list(PUBLISHED), help="which (default: all)")
    add("--folder", type=Path, default=Path("public"), help="for the results (default: public)")
    options = parser.parse_args()
    import onnxscript  # noqa: F401  # an optional library, with which the networks are written: told before a training

    recordings = [check_images(read_recording(folder)) for folder in find_folders(options.recordings)]
    for recording in recordings:
        print_findings(recording)
    if not any(map(len, recordings)):
        raise RecordingError(f"{', '.join(options.recordings)}: no usable row is left to train on")
    with claimed(options.folder):
        for name in options.networks:
            how, file = PUBLISHED[name], options.folder / f"{name}.onnx"
            write_json(file.with_suffix(".json"), how.about)
            save(train(how, file.with_suffix(".json"), recordings), how, file)
            print(f"{file}: {how.source}", flush=True)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
