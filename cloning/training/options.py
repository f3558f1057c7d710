"""The command line of model.py: its options as a typed record, parsed once."""

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TypeVar

from cloning.compute import DEVICES, is_available

Number = TypeVar("Number", int, float)
MAX_SEED = 2**63 - 1  # torch takes no larger one


@dataclass(frozen=True)
class Arguments:
    """The options of a training run, with the report's figures as defaults.

    Every checkpoint holds them as a plain dict, and training_arguments.json lists them. `build_parser` explains each.
    """

    recordings: list[str] = field(default_factory=lambda: ["data"])
    epochs: int = 10
    batch_size: int = 128
    learning_rate: float = 1e-4
    samples_per_epoch: int = 20224
    seed: int = 0
    device: str = "auto"
    throttle_threshold: float = 0.25
    side_correction: float = 0.2
    strict: bool = False
    robust: bool = False
    output: str = "model.pt"
    resume: bool = False


# With --robust every image is warped to another pose, and many small steps learn most from them.
ROBUST_DEFAULTS = {"batch_size": 16, "learning_rate": 3e-4, "samples_per_epoch": 60_000}
REPORT_ONLY = ("throttle_threshold", "side_correction")  # options without an effect in a --robust run


def option(name: str) -> str:
    """The option that sets a field of Arguments: batch_size -> --batch-size."""
    return f"--{name.replace('_', '-')}"


def parse(argv: list[str] | None = None) -> tuple[Arguments, frozenset[str]]:
    """Parse the command line: the arguments, and the names of those that were given.

    Exits with status 2 and a message for an argument that is not possible.
    """
    parser = build_parser()
    values = vars(parser.parse_intermixed_args(argv))  # recordings may follow options
    given = frozenset(values)
    if values.get("robust"):
        for name in REPORT_ONLY:
            if name in given:
                parser.error(f"{option(name)} belongs to the report's training; leave it out with --robust")
        values = {**ROBUST_DEFAULTS, **values}
    arguments = Arguments(**values)
    if Path(arguments.output).is_dir():
        parser.error(f"--output {arguments.output}: is a folder; name the model file in it, such as model.pt")
    if not is_available(arguments.device):
        parser.error(f"--device {arguments.device}: torch finds no such GPU on this machine; leave the option out")
    return arguments, given


def build_parser() -> argparse.ArgumentParser:
    """The parser; an option that is not given sets nothing, so that `Arguments` alone defines the defaults."""
    parser = argparse.ArgumentParser(
        prog="model.py",
        description="Train NVIDIA's network to predict steering from recordings of the Udacity simulator.",
        epilog="The defaults are the report's. Stop a run with Ctrl-C at any time; --resume continues it.",
        argument_default=argparse.SUPPRESS,
    )
    defaults = {item.name: getattr(Arguments(), item.name) for item in fields(Arguments)}

    def text(name: str, help_text: str) -> str:
        return f"{help_text} (default: {defaults[name]})"

    parser.add_argument(
        "recordings",
        nargs="*",
        help="folders that hold a driving_log.csv, at any depth (default: data)",
    )
    group = parser.add_argument_group("training")
    group.add_argument(
        "--epochs", type=number(int, 1), help=text("epochs", "epochs in total; with --resume it may be raised")
    )
    group.add_argument(
        "--batch-size",
        type=number(int, 1),
        help=text("batch_size", "observations in a batch; each gives 3.7 images on average"),
    )
    group.add_argument("--learning-rate", type=number(float, 1e-9), help=text("learning_rate", "learning rate of Adam"))
    group.add_argument(
        "--samples-per-epoch",
        type=number(int, 1),
        help=text("samples_per_epoch", "images in an epoch, at least; a fifth as many observations validate it"),
    )
    group.add_argument(
        "--seed",
        type=number(int, 0, MAX_SEED),
        help=text("seed", "the same seed repeats the same run on the same machine"),
    )
    group.add_argument(
        "--device",
        choices=DEVICES,
        help=text("device", "auto: an NVIDIA GPU if there is one, else Apple's (mps), else the CPU"),
    )
    group = parser.add_argument_group("observations")
    group.add_argument(
        "--throttle-threshold",
        type=number(float),
        help=text("throttle_threshold", "rows with less throttle are dropped"),
    )
    group.add_argument(
        "--side-correction",
        type=number(float),
        help=text("side_correction", "added to the steering of left images, subtracted from that of right ones"),
    )
    group.add_argument("--strict", action="store_true", help="stop at the first unusable row instead of leaving it out")
    group.add_argument(
        "--robust",
        action="store_true",
        help="train for robustness rather than fidelity to the report: learn recovery steering from frames warped to "
        "other lateral offsets and headings; sets "
        + ", ".join(f"{option(name)} {value:g}" for name, value in ROBUST_DEFAULTS.items())
        + " unless they are given",
    )
    group = parser.add_argument_group("output")
    group.add_argument(
        "--output", help=text("output", "the model file; all other files are written to the same folder")
    )
    group.add_argument(
        "--resume",
        action="store_true",
        help="continue the run of this --output with the arguments that it began with; begin it if there is none",
    )
    return parser


def number(
    kind: type[Number], least: float = -sys.float_info.max, most: float = sys.float_info.max
) -> Callable[[str], Number]:
    """A type for argparse: a finite number of this kind, from `least` to `most`."""

    def parse_number(text: str) -> Number:
        value = kind(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text} is not a number from {least:.10g} to {most:.10g}")
        return value

    parse_number.__name__ = kind.__name__  # argparse names it: "invalid int value"
    return parse_number
