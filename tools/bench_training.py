"""How fast `model.py` trains, beside what bounds it and beside what people write today, in one run.

    python -m tools.bench_training                                  # over a third of a lap that it renders
    python -m tools.bench_training data/lake-ccw data/lake-cw       # over real ones

(a) model.py's own epoch: generator, step, saving, pictures and validation
(b) the bare optimisation step on one resident batch, as model.py does it
(c) what people write today: fp32, contiguous, the whole batch at once, images decoded and augmented one by one by the
    training's own thread
(k) Keras with the classic generator, where TensorFlow is installed
and the processor's own product of two matrices, which bounds (b). Each part is a process of its own; the parts take
turns, so that a machine that slows down slows them all. Rates are training images per second.
"""

import argparse
import importlib.util
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cloning.compute import keep_freed_memory
from cloning.road.track import Track

PARTS = ("bound", "ab", "c", "k")
NAMES = {
    "bound": "bound by the matrix product",
    "a": "(a) model.py's epoch",
    "b": "(b) bare step",
    "c": "(c) what people write today",
    "k": "(k) Keras, classic generator",
}


def begin(folders: list[str], samples: int, output: Path):
    """A model.py run over these folders, not yet trained."""
    import model

    options = ["--samples-per-epoch", str(samples), "--epochs", "1", "--output", str(output)]
    arguments, training, validation, _ = model.prepare(*model.parse([*folders, *options]))
    return model.TrainingRun(arguments, training, validation)


def flops(network) -> int:
    """Multiplications and additions an image costs, forward and backward."""
    import torch

    total = []

    def count(module, inputs, output):
        products = 2 * output[0].numel() * module.weight[0].numel()
        total.append(products * (2 if module is network.convolutions[0] else 3))  # frames need no gradient

    hooks = [module.register_forward_hook(count) for module in (*network.convolutions, *network.dense)]
    network(torch.zeros((1, 160, 320, 3), dtype=torch.uint8, device=next(network.parameters()).device))
    for hook in hooks:
        hook.remove()
    return sum(total)


def part_ab(run, _):
    """Both in one process, a bare step after every fourth batch, so that what else the machine does falls on both."""
    bare, write_pictures, turns = run.generator.begin(0)(), run.write_pictures, itertools.count(1)
    spent, steps = 0.0, 0

    def between_batches():
        nonlocal spent, steps
        write_pictures()
        if next(turns) % 4 == 0:
            run.pool.submit(int).result()  # behind the images of the next batch, which are (a)'s
            started = time.perf_counter()
            (run.errors(bare) / bare.total).backward()
            run.optimizer.step()
            run.optimizer.zero_grad()
            synchronize(run.device)
            spent, steps = spent + time.perf_counter() - started, steps + 1

    run.write_pictures = between_batches
    started = time.perf_counter()
    run.train()
    whole = time.perf_counter() - started - spent
    return {"a": run.progress.history[0]["images"] / whole, "b": steps * bare.total / spent}


def one_by_one(generator, number: int):
    """A batch as a classic generator makes it, from its files, an image at a time: images and angles."""
    import numpy as np

    from cloning.recordings.format import FRAME
    from model import CROP, augment, of_each_kind

    choices, images, angles = generator.sample(number), [], []
    for i, (at, camera) in enumerate(zip(choices.observation, choices.camera, strict=True)):
        cropped = generator.observations.read(at, camera)[None, CROP[0] : FRAME[0] - CROP[1]]
        for kind, (which, made) in enumerate(augment(choices, np.array([i]), of_each_kind(cropped), CROP[0])):
            images += list(made)
            angles += [choices.views.labels[i, kind]] * len(which)
    return np.stack(images), np.array(angles)


def part_c(run, steps):
    import torch

    network = run.network.to(memory_format=torch.contiguous_format)
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    optimizer = torch.optim.Adam(network.parameters(), 1e-4)
    numbers = iter(range(1000))

    def step():
        made, angles = one_by_one(run.generator, next(numbers))
        frames = torch.from_numpy(made).to(run.device)
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

    return {"c": rate(step, 474, steps, run.device)}


def part_k(run, steps):
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

    def step():
        network.train_on_batch(*one_by_one(run.generator, next(numbers)))

    return {"k": rate(step, 474, steps, run.device)}


def part_bound(run, _):
    """Images a second, if a step were nothing but the products of matrices, at the best speed of several."""
    import torch

    torch.set_num_threads(len(os.sched_getaffinity(0)))
    size = 2048 if run.device.type == "cpu" else 8192
    a, b = (torch.randn(size, size, device=run.device).to(run.precision) for _ in "ab")
    return {"bound": max(rate(lambda: a @ b, 1, 1, run.device) for _ in range(8)) * 2 * size**3 / flops(run.network)}


def rate(step, images: int, steps: int, device) -> float:
    """Images a second over these steps, after one that does not count."""
    step()
    synchronize(device)
    started = time.perf_counter()
    for _ in range(steps):
        step()
    synchronize(device)
    return images * steps / (time.perf_counter() - started)


def synchronize(device) -> None:
    """Wait for a GPU's work to be done."""
    if device.type == "cuda":
        import torch

        torch.cuda.synchronize(device)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("recordings", nargs="*", help="folders; without any, a third of a lap is rendered")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--samples", type=int, default=20224, help="images of the epoch in (a)")
    parser.add_argument("--steps", type=int, default=5, help="counted batches in (b), (c) and (k)")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.part:
            if arguments.part == "ab":
                keep_freed_memory()  # as model.py's main does
            run = begin(arguments.recordings, arguments.samples, Path(folder) / "model.pt")
            rates = globals()[f"part_{arguments.part}"](run, arguments.steps)
            print(
                "\n"
                + json.dumps(
                    {
                        "rates": rates,
                        "gb": peak_memory(),
                        "device": str(run.device),
                        "precision": str(run.precision),
                        "flops": flops(run.network),
                    }
                )
            )
            return
        if not arguments.recordings:
            from simulator.record import record

            record(f"{folder}/rendered", Track("lake"), laps=0.35)
            arguments.recordings = [f"{folder}/rendered"]
        report(arguments)


def peak_memory() -> float:
    """Of this process: GB resident at the most."""
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def report(arguments) -> None:
    parts = [part for part in PARTS if part != "k" or importlib.util.find_spec("tensorflow")]
    rates: dict[str, list[float]] = {}
    memory: dict[str, float] = {}
    for number in range(arguments.rounds):
        for part in parts:
            command = [
                sys.executable,
                "-m",
                "tools.bench_training",
                *arguments.recordings,
                "--part",
                part,
                "--samples",
                str(arguments.samples),
                "--steps",
                str(arguments.steps),
            ]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
            found = json.loads(done.stdout.splitlines()[-1])
            for name, value in found["rates"].items():
                rates.setdefault(name, []).append(value)
                memory[name] = max(memory.get(name, 0), found["gb"])
                print(f"round {number + 1}: {NAMES[name]}: {value:.0f}", file=sys.stderr, flush=True)
    print(
        f"\n{found['device']}, {found['precision'].removeprefix('torch.')}, {arguments.rounds} rounds, "
        f"{found['flops'] / 1e6:.0f} MFLOP an image\n"
    )
    print("| training images/s | median | least | most | peak memory GB |\n|---|---|---|---|---|")
    for name, values in rates.items():
        values = sorted(values)
        print(f"| {NAMES[name]} | {median(values):.0f} | {values[0]:.0f} | {values[-1]:.0f} | {memory[name]:.2f} |")
    print("\n| ratio, round by round | median | least | most |\n|---|---|---|---|")
    for above, below in (("b", "bound"), ("a", "b"), ("a", "c"), *((("a", "k"),) if "k" in parts else ())):
        ratios = sorted(x / y for x, y in zip(rates[above], rates[below], strict=True))
        print(f"| {above} / {below} | {median(ratios):.2f} | {ratios[0]:.2f} | {ratios[-1]:.2f} |")


def median(values: list[float]) -> float:
    """The middle one of sorted values."""
    return (values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2


if __name__ == "__main__":
    main()
