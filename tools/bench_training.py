"""Measure how fast `model.py` trains, compared with the processor's limit and with a typical training loop.

    python -m tools.bench_training                                  # on a third of a lap, rendered for this purpose
    python -m tools.bench_training data/lake-ccw data/lake-cw       # on these recordings

(a) an epoch of model.py: generator, optimisation steps, checkpoints, pictures and validation
(b) only the optimisation step, as model.py does it, repeated on one batch in memory
(c) a typical training loop: float32, contiguous tensors, the whole batch at once; the training thread itself decodes
    and augments the images one by one
(k) Keras with the same one-by-one generator, if TensorFlow is installed

The limit for (b) is the rate at which the processor could train if it only multiplied matrices, or if it only moved the
activations in memory, whichever is lower. Each part runs in a process of its own; the parts take turns, so that a
change of the machine's speed affects all of them. Rates are in training images per second. On a CPU, a last table shows
what each layer costs.
"""

import argparse
import importlib.util
import itertools
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from unittest import mock

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("bench_training")  # also while the libraries below are loaded

from cloning.base.arguments import number
from cloning.base.errors import UserError
from cloning.network.compute import keep_freed_memory, threads
from cloning.road.track import Track

if TYPE_CHECKING:
    import numpy as np
    import torch

    import model
    from cloning.network.network import Network

PARTS = ("limit", "ab", "c", "k")  # that measure rates
BATCH_IMAGES = 474  # images in a batch of 128 observations, at 3.7 images each on average
NAMES = {
    "limit": "limit by matrix multiplication",
    "memory": "limit by memory traffic",
    "a": "(a) an epoch of model.py",
    "b": "(b) only the optimisation step",
    "c": "(c) a typical training loop",
    "k": "(k) Keras, one-by-one generator",
}


def begin(folders: list[str], samples: int, output: Path) -> "model.TrainingRun":
    """Prepare a run of model.py on these folders, without training."""
    import model
    from cloning.training.distributed import Ranks
    from cloning.training.options import Command, Process, Run

    recipe = replace(model.REPORT, samples_per_epoch=samples, epochs=1)
    command = Command(Run(recipe, tuple(folders)), Process(str(output)), frozenset(), {})
    run = model.TrainingRun(model.prepare(command), command.process, Ranks())
    run.files.pictures.mkdir()
    return run


def flops(network: "Network") -> int:
    """Count the multiplications and additions per image, forward and backward."""
    import torch

    from tools.bench_layers import operations

    total: list[int] = []

    def count(module: torch.nn.Module, _: tuple, output: torch.Tensor) -> None:
        assert isinstance(module, torch.nn.Conv2d | torch.nn.Linear)
        passes = 2 if module is network.convolutions[0] else 3  # no gradient for the image
        total.append(operations(module, output) * passes)

    hooks = [module.register_forward_hook(count) for module in (*network.convolutions, *network.dense)]
    network(torch.zeros((1, 160, 320, 3), dtype=torch.uint8, device=next(network.parameters()).device))
    for hook in hooks:
        hook.remove()
    return sum(total)


def part_ab(run: "model.TrainingRun", _: int) -> dict[str, float]:
    """Measure (a) and (b) in one process, with a step of (b) after every fourth batch of (a).

    So other load on the machine affects both equally.
    """
    fixed_batch, write_pictures, turns = run.generator.start_batch(0)(), run.write_pictures, itertools.count(1)
    spent, steps = 0.0, 0

    def between_batches() -> None:
        nonlocal spent, steps
        write_pictures()
        if next(turns) % 4 == 0:
            run.pool.submit(int).result()  # wait for the next batch's images, whose time belongs to (a)
            started = time.perf_counter()
            (run.errors(fixed_batch) / fixed_batch.total).backward()
            run.optimizer.step(run.recipe.learning_rate)
            run.optimizer.zero_grad()
            synchronize(run.device)
            spent, steps = spent + time.perf_counter() - started, steps + 1

    started = time.perf_counter()
    with mock.patch.object(run, "write_pictures", between_batches):
        run.train()
    epoch_seconds = time.perf_counter() - started - spent
    return {"a": run.progress.history[0]["images"] / epoch_seconds, "b": steps * fixed_batch.total / spent}


def one_by_one(generator: "model.Generator", number: int) -> tuple["np.ndarray", "np.ndarray"]:
    """Return a batch made as in a typical generator, one image at a time from its file.

    images: uint8 (n, 75, 320, 3); labels: float32 (n,).
    """
    import cv2
    import numpy as np

    from cloning.network.network import CROP, SEEN_ROWS

    choices, images, angles = generator.sample(number), [], []
    for i, (at, camera) in enumerate(zip(choices.observation, choices.camera, strict=True)):
        seen = generator.observations.read(at, camera)[SEEN_ROWS]
        for kind, augmentation in enumerate(generator.recipe.augmentations):
            if choices.slots[i, kind] >= 0:
                chosen = [column[i : i + 1] for column in choices.augmenting[kind]]
                image = cv2.flip(seen, 1) if augmentation.mirrors else seen
                images.append(augmentation.change(image[None], CROP[0], *chosen)[0])
                angles.append(choices.views.labels[i, kind])
    return np.stack(images), np.array(angles)


def part_c(run: "model.TrainingRun", steps: int) -> dict[str, float]:
    """Measure (c), a typical training loop."""
    import torch

    network = run.network
    for parameter in network.parameters():
        parameter.data = parameter.data.contiguous()  # in model.py they are channels last
    torch.set_num_threads(threads())
    optimizer = torch.optim.Adam(network.parameters(), 1e-4)
    numbers = iter(range(1000))

    def step() -> None:
        images, angles = one_by_one(run.generator, next(numbers))
        frames = torch.from_numpy(images).to(run.device)
        x = (frames.permute(0, 3, 1, 2).float() / 127.5 - 1).contiguous()
        for convolution in network.convolutions:
            x = torch.nn.functional.elu(convolution(x))
        x = torch.nn.functional.dropout(x.flatten(1), 0.5)
        for layer in network.dense[:-1]:
            x = torch.nn.functional.elu(layer(x))
        loss = ((network.dense[-1](x)[:, 0] - torch.from_numpy(angles).to(run.device)) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return {"c": rate(step, BATCH_IMAGES, steps, run.device)}


def part_k(run: "model.TrainingRun", steps: int) -> dict[str, float]:
    """Measure (k), Keras with the one-by-one generator."""
    import keras

    layers = keras.layers
    network = keras.Sequential(
        [
            layers.Input((75, 320, 3)),
            layers.Rescaling(1 / 127.5, -1),
            *[
                layers.Conv2D(filters, size, stride, activation="elu")
                for filters, size, stride in ((24, 5, 2), (36, 5, 2), (48, 5, 2), (64, 3, 1), (64, 3, 1))
            ],
            layers.Flatten(),
            layers.Dropout(0.5),
            *[layers.Dense(n, activation="elu") for n in (100, 50, 10)],
            layers.Dense(1),
        ]
    )
    network.compile(optimizer=keras.optimizers.Adam(1e-4), loss="mse")
    numbers = iter(range(1000))

    def step() -> None:
        network.train_on_batch(*one_by_one(run.generator, next(numbers)))

    return {"k": rate(step, BATCH_IMAGES, steps, run.device)}


def part_limit(run: "model.TrainingRun", _: int) -> dict[str, float]:
    """Measure the limits: images per second if a step only multiplied matrices, or only moved its activations.

    Each is the best of eight measurements; the second one only on a CPU.
    """
    import torch

    from tools import bench_layers

    torch.set_num_threads(threads())
    size = 2048 if run.device.type == "cpu" else 8192
    a, b = (torch.randn(size, size, device=run.device).to(run.precision) for _ in "ab")
    fastest = max(rate(lambda: a @ b, 1, 1, run.device) for _ in range(8)) * 2 * size**3
    limits = {"limit": fastest / flops(run.network)}
    if run.device.type == "cpu":
        limits["memory"] = bench_layers.memory_limit(run.network, run.precision)
    return limits


def rate(step: Callable[[], object], images: int, steps: int, device: "torch.device") -> float:
    """Return the images per second over these steps, after one step that is not counted."""
    step()
    synchronize(device)
    started = time.perf_counter()
    for _ in range(steps):
        step()
    synchronize(device)
    return images * steps / (time.perf_counter() - started)


def synchronize(device: "torch.device") -> None:
    """Wait until a GPU has finished its work."""
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)


PART_FUNCTIONS = {"limit": part_limit, "ab": part_ab, "c": part_c, "k": part_k}


def layer_table(run: "model.TrainingRun") -> str:
    """Return what each layer costs in an optimisation step, as a table."""
    from tools import bench_layers

    keep_freed_memory()
    return bench_layers.table(*bench_layers.costs(run.network, run.precision))


def measure(part: str, recordings: list[str], samples: int, steps: int, folder: Path) -> dict:
    """Measure one part in this process; return its rates in images per second, memory, device and precision."""
    if part == "ab":
        keep_freed_memory()  # as model.py does
    run = begin(recordings, samples, folder / "model.pt")
    rates = PART_FUNCTIONS[part](run, steps)
    return {
        "rates": rates,
        "gb": peak_memory(),
        "device": str(run.device),
        "precision": str(run.precision),
        "flops": flops(run.network),
    }


def peak_memory() -> float | None:
    """Return the peak resident memory of this process in GB, or None on Windows, where it is unknown."""
    if sys.platform == "win32":
        return None
    import resource

    unit = 1e9 if sys.platform == "darwin" else 1e6  # bytes on macOS, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


def compare(recordings: list[str], rounds: int, samples: int, steps: int) -> None:
    """Measure every part in each round and print the tables."""
    parts = [part for part in PARTS if part != "k" or importlib.util.find_spec("tensorflow")]
    rates: dict[str, list[float]] = {}
    memory: dict[str, float] = {}
    measured: dict = {}

    def output(part: str) -> str:
        command = [sys.executable, "-m", "tools.bench_training", *recordings, "--part", part]
        command += ["--samples", str(samples), "--steps", str(steps)]
        process = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        if process.returncode:
            raise UserError(f"part {part} failed; its error message is above")
        return process.stdout

    for round_number in range(1, rounds + 1):
        for part in parts:
            measured = json.loads(output(part).splitlines()[-1])
            for name, value in measured["rates"].items():
                rates.setdefault(name, []).append(value)
                memory[name] = max(memory.get(name, 0.0), measured["gb"] or 0.0)
                print(f"round {round_number}: {NAMES[name]}: {value:.0f}", file=sys.stderr, flush=True)
    precision = measured["precision"].removeprefix("torch.")
    print(f"\n{measured['device']}, {precision}, {rounds} rounds, {measured['flops'] / 1e6:.0f} MFLOP per image\n")
    print("| training images/s | median | least | most | peak memory GB |\n|---|---|---|---|---|")
    for name, values in rates.items():
        cells = (statistics.median(values), min(values), max(values))
        print(f"| {NAMES[name]} | {' | '.join(f'{cell:.0f}' for cell in cells)} | {memory[name]:.2f} |")
    print("\n| ratio in each round | median | least | most |\n|---|---|---|---|")
    if "memory" in rates:
        rates["limit"] = [min(pair) for pair in zip(rates["limit"], rates["memory"], strict=True)]
    for above, below in (("b", "limit"), ("a", "b"), ("a", "c"), *((("a", "k"),) if "k" in parts else ())):
        ratios = [x / y for x, y in zip(rates[above], rates[below], strict=True)]
        print(f"| {above} / {below} | {statistics.median(ratios):.2f} | {min(ratios):.2f} | {max(ratios):.2f} |")
    if measured["device"] == "cpu":
        layers = output("layers")
        print(f"\n{layers[layers.index('| layer') :]}", end="")


def main() -> int:
    """Run the benchmark, or with --part one part of it, in a process that it started; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="bench_training", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "recordings", nargs="*", help="folders of recordings; without any, a third of a lap is rendered"
    )
    parser.add_argument(
        "--rounds", type=number(int, 1), default=3, help="measurements of each part (default %(default)s)"
    )
    parser.add_argument(
        "--samples",
        type=number(int, 5 * BATCH_IMAGES),
        default=20224,
        help="images per epoch in (a), at least five batches (default %(default)s)",
    )
    parser.add_argument(
        "--steps", type=number(int, 1), default=5, help="measured batches in (c) and (k) (default %(default)s)"
    )
    parser.add_argument("--part", choices=(*PARTS, "layers"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    try:
        with tempfile.TemporaryDirectory() as folder:
            if args.part == "layers":
                print("\n" + layer_table(begin(args.recordings, args.samples, Path(folder, "model.pt"))))
                return program.DONE
            if args.part:
                measured = measure(args.part, args.recordings, args.samples, args.steps, Path(folder))
                print("\n" + json.dumps(measured))
                return program.DONE
            if not args.recordings:
                from simulator.record import record

                args.recordings = [f"{folder}/rendered"]
                record(args.recordings[0], Track("lake"), laps=0.35)
            compare(args.recordings, args.rounds, args.samples, args.steps)
    except UserError as error:
        return program.failed("bench_training", error)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
