"""The command line of model.py."""

import argparse
from dataclasses import dataclass, field, fields
from pathlib import Path

from cloning.base.arguments import number
from cloning.network.compute import DEVICES, is_available
from cloning.recordings.format import DRIVING_LOG, PROBLEM_AREAS

MAX_SEED = 2**63 - 1  # torch takes no larger one
MAX_COUNT = 10**9  # of epochs or images: more than a lifetime of training
MAX_BATCH = 10**5  # observations: 56 GB of images
MAX_REPEATS = 1000  # the report's training keeps as many copies of the rows in memory


@dataclass(frozen=True)
class Arguments:
    """The options of a training run, with the report's figures as defaults.

    Checkpoints contain them as a dict, and training_arguments.json lists them. `build_parser` explains each option.
    """

    recordings: list[str] = field(default_factory=lambda: ["data"])
    epochs: int = 10
    batch_size: int = 128
    learning_rate: float = 1e-4
    optimizer: str = "adam"  # no option, nor is loss: see ROBUST_METHOD; runs of earlier versions go on as they began
    loss: str = "squared"
    samples_per_epoch: int = 20224
    seed: int = 0
    device: str = "auto"
    throttle_threshold: float = 0.25
    side_correction: float = 0.2
    repeats: int = 4
    strict: bool = False
    robust: bool = False
    from_: str = ""
    output: str = "model.pt"
    resume: bool = False


# With --robust, many small steps learn most from the warped images. After 30,000 of the jungle, Muon had a val_loss of
# 0.065, 0.056, 0.051 and 0.053 at 5e-4, 1e-3, 2e-3 and 4e-3, which learned most (Adam at 1e-3: 0.068); after 8,000 of
# a lake lap 0.013, 0.008 and 0.007 at 2e-3, 4e-3 and 8e-3. Four epochs of 70 recordings had the val_loss of 28 with
# Adam, 0.017. tools/experiments.md has more.
ROBUST_DEFAULTS = {"epochs": 4, "batch_size": 16, "learning_rate": 4e-3, "samples_per_epoch": 60_000}
ROBUST_METHOD = {"optimizer": "muon", "loss": "huber"}
REPORT_ONLY = ("throttle_threshold", "side_correction")  # options without an effect in a --robust run


def option(name: str) -> str:
    """Return the option that sets a field of Arguments: batch_size -> --batch-size; from_, a Python word -> --from."""
    return f"--{name.rstrip('_').replace('_', '-')}"


def parse(argv: list[str] | None = None) -> tuple[Arguments, frozenset[str]]:
    """Parse the command line; return the arguments, and the names of those that were given.

    argv: of this process if None. Exits with status 2 and a message for an unusable argument.
    """
    parser = build_parser()
    values = vars(parser.parse_intermixed_args(argv))  # recordings may follow options
    given = frozenset(values)
    if values.get("robust"):
        for name in REPORT_ONLY:
            if name in given:
                parser.error(f"{option(name)} has no effect with --robust; leave it out")
        values = {**ROBUST_DEFAULTS, **values, **ROBUST_METHOD}
    arguments = Arguments(**values)
    if Path(arguments.output).is_dir():
        parser.error(f"--output {arguments.output}: is a folder; name the model file in it, such as model.pt")
    if not is_available(arguments.device):
        parser.error(f"--device {arguments.device}: torch finds no such GPU on this machine; leave the option out")
    return arguments, given


def build_parser() -> argparse.ArgumentParser:
    """Return the parser; it sets no defaults, which `Arguments` defines."""
    parser = argparse.ArgumentParser(
        prog="model.py",
        description="Train NVIDIA's network to predict steering from recordings of the Udacity simulator.",
        epilog="The defaults are those of the report of Udacity's Behavioral Cloning project. "
        "Stop a run with Ctrl-C at any time; --resume continues it.",
        argument_default=argparse.SUPPRESS,
    )
    defaults = {item.name: getattr(Arguments(), item.name) for item in fields(Arguments)}

    def text(name: str, help_text: str) -> str:
        return f"{help_text} (default: {defaults[name]})"

    parser.add_argument(
        "recordings",
        nargs="*",
        help="recordings, or folders with recordings at any depth below them; a recording is a folder with a "
        f"{DRIVING_LOG} (default: data)",
    )
    group = parser.add_argument_group("training")
    group.add_argument(
        "--epochs", type=number(int, 1, MAX_COUNT), help=text("epochs", "epochs in total; may be raised with --resume")
    )
    group.add_argument(
        "--batch-size",
        type=number(int, 1, MAX_BATCH),
        help=text("batch_size", "observations in a batch; each gives 3.7 images on average"),
    )
    group.add_argument(
        "--learning-rate",
        type=number(float, 1e-9, 10),
        help=text("learning_rate", "learning rate of Adam or, with --robust, of Muon"),
    )
    group.add_argument(
        "--samples-per-epoch",
        type=number(int, 1, MAX_COUNT),
        help=text(
            "samples_per_epoch", "smallest number of images in an epoch; a fifth as many observations validate it"
        ),
    )
    group.add_argument(
        "--seed",
        type=number(int, 0, MAX_SEED),
        help=text("seed", "on the same machine, the same seed repeats the same run"),
    )
    group.add_argument(
        "--from",
        dest="from_",
        metavar="MODEL",
        help="begin with the weights of this model file (default: random weights)",
    )
    group.add_argument(
        "--device",
        choices=DEVICES,
        help=text("device", "cuda: an NVIDIA GPU; mps: Apple's GPU; auto: the first of cuda, mps and cpu that exists"),
    )
    group = parser.add_argument_group("observations")
    group.add_argument(
        "--throttle-threshold",
        type=number(float),
        help=text("throttle_threshold", "drop rows with less throttle, 0 to 1"),
    )
    group.add_argument(
        "--side-correction",
        type=number(float),
        help=text("side_correction", "steering added to the label of left images, subtracted from that of right ones"),
    )
    group.add_argument(
        "--repeats",
        type=number(int, 1, MAX_REPEATS),
        help=text("repeats", f"how often a recording counts whose name ends in {' or '.join(PROBLEM_AREAS)}"),
    )
    group.add_argument("--strict", action="store_true", help="fail if a row is unusable, instead of leaving it out")
    group.add_argument(
        "--robust",
        action="store_true",
        help="train for robustness rather than fidelity to the report: learn recovery steering from frames warped to "
        "other lateral offsets and headings; uses "
        + ", ".join(f"{option(name)} {value:g}" for name, value in ROBUST_DEFAULTS.items())
        + " unless these are given",
    )
    group = parser.add_argument_group("output")
    group.add_argument("--output", help=text("output", "model file; all other files are written to its folder"))
    group.add_argument(
        "--resume",
        action="store_true",
        help="continue the run of this --output with its original arguments; begin a new run if there is none",
    )
    return parser
