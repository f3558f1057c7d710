"""Train and measure one network of the study, in a process of its own; `python -m tools.study` starts it."""

import argparse
import csv
from pathlib import Path

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("study")

import torch

from cloning.base.errors import UserError
from cloning.base.outputs import write_json
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import load_recording, reference_lines
from tools.study.measures import Simulator, laps, offline, replayed
from tools.study.networks import TRACKS, plan, train

RESULT = "result.json"  # in a network's folder, when it is measured


def measure(name: str, recordings: Path, folder: Path, epoch_images: int, share: float, starts: int) -> int:
    """Train and measure a network, and write its result; return the exit status.

    name: of the plan; recordings: the folder of the real recordings; folder: the network's; epoch_images: number of
    images in an epoch; share: of a lap to drive; starts: number of starts from which it is to recover.

    Raises UserError.
    """
    variant = next(variant for variant in plan() if variant.name == name)
    if status := train(variant, recordings, folder, epoch_images):
        return status
    torch.set_num_threads(1)
    driver, track = ModelDriver(str(folder / "model.pt")), TRACKS[variant.track]
    recording = load_recording(recordings / track.held_out)
    with open(folder / "training_log.csv", encoding="utf-8", newline="") as file:
        losses = [float(epoch["val_loss"]) for epoch in csv.DictReader(file)]
    result = {"own_val_loss": losses[-1], "best_val_loss": min(losses)}
    result |= offline(driver.network, recording)
    result |= replayed(recording, reference_lines(recording), driver)
    simulators = [Simulator(driver.network, variant.track, direction, track.speed) for direction in track.directions]
    result |= laps(simulators, share)
    if variant.recovers:
        result["recovered"] = simulators[0].recovery(starts)
    write_json(folder / RESULT, {key: round(value, 6) for key, value in result.items()})
    return program.DONE


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = argparse.ArgumentParser(prog="study", description=__doc__)
    parser.add_argument("name")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("epoch_images", type=int)
    parser.add_argument("share", type=float)
    parser.add_argument("starts", type=int)
    args = parser.parse_args(argv)
    try:
        return measure(**vars(args))
    except (UserError, OSError) as error:
        return program.failed("study", error)


if __name__ == "__main__":
    program.run(main)
