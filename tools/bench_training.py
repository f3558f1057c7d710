"""Measure how fast `model.py` trains, compared with the processor's limit and with a typical training loop.

    python -m tools.bench_training                                  # on a third of a lap, rendered for this purpose
    python -m tools.bench_training data/lake-ccw data/lake-cw       # on these recordings

(a) an epoch of model.py: generator, optimisation steps, checkpoints, pictures and validation
(b) only the optimisation step, as model.py does it, repeated on one batch in memory
(c) a typical training loop: float32, contiguous tensors, the whole batch at once; the training thread itself decodes
    and augments the images one by one

The limit for (b) is the rate at which the processor could train if it only multiplied matrices. Each part runs in a
process of its own; the parts take turns, so that a change of the machine's speed affects all of them. Rates are in
training images per second.
"""

import argparse
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
from unittest import mock

import cv2
import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

import model
from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import UserError
from cloning.base.frame import FRAME
from cloning.network.compute import keep_freed_memory, threads
from cloning.network.network import CROP, SEEN_ROWS, Network
from cloning.road.track import Track
from cloning.training.distributed import Ranks
from cloning.training.observations import read_checked
from cloning.training.options import Command, Process, Run
from simulator.record import record
from tools.command import head, python, row

BATCH_IMAGES = 474  # images in a batch of 128 observations, at 3.7 images each on average
NAMES = {
    "limit": "limit by matrix multiplication",
    "a": "(a) an epoch of model.py",
    "b": "(b) only the optimisation step",
    "c": "(c) a typical training loop",
}
RATIOS = (("b", "limit"), ("a", "b"), ("a", "c"))


def begin(folders: list[str], samples: int, output: Path) -> model.TrainingRun:
    """Prepare a run of model.py on these folders, without training."""
    recipe = replace(model.REPORT, samples_per_epoch=samples, epochs=1)
    command = Command(Run(recipe, tuple(folders)), Process(str(output)), frozenset(), {})
    run = model.TrainingRun(model.prepare(command), command.process, Ranks())
    run.files.pictures.mkdir()
    return run


def flops(network: Network) -> int:
    """Count the multiplications and additions per image, forward and backward."""
    image = torch.zeros((1, *FRAME), dtype=torch.uint8, device=next(network.parameters()).device)
    with FlopCounterMode(display=False) as counter:
        network(image).sum().backward()
    return counter.get_total_flops()


def part_ab(run: model.TrainingRun, _: int) -> dict[str, float]:
    """Measure (a) and (b) together, a step of (b) after every fourth batch of (a): other load affects both alike."""
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


def one_by_one(generator: model.Generator, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Make a batch as a typical generator does, one image at a time: uint8 (n, 75, 320, 3), labels float32 (n,)."""
    choices, images, angles = generator.sample(number), [], []
    for i, (at, camera) in enumerate(zip(choices.observation, choices.camera, strict=True)):
        seen = read_checked(generator.observations.path(at, camera))[SEEN_ROWS]
        for kind, augmentation in enumerate(generator.recipe.augmentations):
            if choices.slots[i, kind] >= 0:
                chosen = [column[i : i + 1] for column in choices.augmenting[kind]]
                image = cv2.flip(seen, 1) if augmentation.mirrors else seen
                images.append(augmentation.change(image[None], CROP[0], *chosen)[0])
                angles.append(choices.views.labels[i, kind])
    return np.stack(images), np.array(angles)


def part_c(run: model.TrainingRun, steps: int) -> dict[str, float]:
    """Measure (c), a typical training loop."""
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


def part_limit(run: model.TrainingRun, _: int) -> dict[str, float]:
    """Measure the limit: images per second if a step only multiplied matrices; the best of eight measurements."""
    torch.set_num_threads(threads())
    size = 2048 if run.device.type == "cpu" else 8192
    a, b = (torch.randn(size, size, device=run.device).to(run.precision) for _ in "ab")
    fastest = max(rate(lambda: a @ b, 1, 1, run.device) for _ in range(8)) * 2 * size**3
    return {"limit": fastest / flops(run.network)}


def rate(step: Callable[[], object], images: int, steps: int, device: torch.device) -> float:
    """Return the images per second over these steps, after one step that is not counted."""
    step()
    synchronize(device)
    started = time.perf_counter()
    for _ in range(steps):
        step()
    synchronize(device)
    return images * steps / (time.perf_counter() - started)


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


PARTS = {"limit": part_limit, "ab": part_ab, "c": part_c}


def measure(part: str, recordings: list[str], samples: int, steps: int) -> dict:
    """Measure one part in this process; return its rates in images per second, memory, device and precision."""
    if part == "ab":
        keep_freed_memory()  # as model.py does
    with tempfile.TemporaryDirectory() as folder:
        training = begin(recordings, samples, Path(folder, "model.pt"))
        rates = PARTS[part](training, steps)
    return {
        "rates": rates,
        "gb": peak_memory(),
        "device": str(training.device),
        "precision": str(training.precision).removeprefix("torch."),
        "flops": flops(training.network),
    }


def peak_memory() -> float:
    """Return the peak resident memory of this process in GB, or 0 on Windows, where it is unknown."""
    if sys.platform == "win32":
        return 0.0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024  # bytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def compare(recordings: list[str], rounds: int, samples: int, steps: int) -> None:
    """Measure every part in each round, in processes of their own, and print the tables."""
    rates: dict[str, list[float]] = {}
    memory: dict[str, float] = {}
    measured: dict = {}
    options = ("--samples", samples, "--steps", steps)
    for turn, part in itertools.product(range(1, rounds + 1), PARTS):
        done = python("-m", "tools.bench_training", *recordings, "--part", part, *options, stdout=subprocess.PIPE)
        if done.returncode:
            raise UserError(f"part {part} failed; its error message is above")
        measured = json.loads(done.stdout.splitlines()[-1])
        for name, value in measured["rates"].items():
            rates.setdefault(name, []).append(value)
            memory[name] = max(memory.get(name, 0.0), measured["gb"])
            print(f"round {turn}: {NAMES[name]}: {value:.0f}", file=sys.stderr, flush=True)
    print(f"\n{measured['device']}, {measured['precision']}, {rounds} rounds, ", end="")
    print(f"{measured['flops'] / 1e6:.0f} MFLOP per image\n")
    print(head("training images/s", "median", "least", "most", "peak memory GB"))
    for name, values in rates.items():
        print(row(NAMES[name], *spread(values, 0), f"{memory[name]:.2f}"))
    print(f"\n{head('ratio in each round', 'median', 'least', 'most')}")
    for above, below in RATIOS:
        print(row(f"{above} / {below}", *spread([x / y for x, y in zip(rates[above], rates[below], strict=True)], 2)))


def spread(values: list[float], digits: int) -> list[str]:
    """Return the median, the least and the greatest value as texts with so many digits after the point."""
    return [f"{value:.{digits}f}" for value in (statistics.median(values), min(values), max(values))]


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark, or with --part one part of it, in a process that it started; return the exit status."""
    parser = command_line("python -m tools.bench_training", __doc__)
    add = parser.add_argument
    add("recordings", nargs="*", help="folders of recordings; without any, a third of a lap is rendered")
    add("--rounds", type=number(int, 1), default=3, help="measurements of each part (default %(default)s)")
    samples = "images per epoch in (a), at least five batches (default %(default)s)"
    add("--samples", type=number(int, 5 * BATCH_IMAGES), default=20224, help=samples)
    add("--steps", type=number(int, 1), default=5, help="measured batches in (c) (default %(default)s)")
    add("--part", choices=PARTS, help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.part:
        print("\n" + json.dumps(measure(options.part, options.recordings, options.samples, options.steps)))
        return program.DONE
    with tempfile.TemporaryDirectory() as folder:
        if not options.recordings:
            options.recordings = [f"{folder}/rendered"]
            record(options.recordings[0], Track("lake"), laps=0.35)
        compare(options.recordings, options.rounds, options.samples, options.steps)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
