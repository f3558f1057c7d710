"""model.py's command line: its options, the files that they name, and the run that --resume goes on with."""

import argparse
from pathlib import Path

from cloning.errors import ModelError
from cloning.pilot.network import load_checkpoint

# What --robust sets, where it is not given: poses make every image another, and many small steps learn from them.
ROBUST = {"batch_size": 16, "learning_rate": 3e-4, "samples_per_epoch": 60_000}


def parse(argv: list[str] | None = None) -> tuple[argparse.Namespace, dict]:
    """The command line's arguments, and of them those that were given."""
    parser = argparse.ArgumentParser(
        description="Train NVIDIA's network to steer, from recordings of the Udacity simulator.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        epilog="The defaults are the report's. Interrupt with Ctrl-C at any time; --resume goes on.",
    )
    parser.add_argument(
        "recordings", nargs="*", default=["data"], help="folders with a driving_log.csv, or folders of such folders"
    )
    add = parser.add_argument_group("training").add_argument
    add("--epochs", type=at_least(1, int), default=10, help="epochs in all, also with --resume")
    add("--batch-size", type=at_least(1, int), default=128, help="observations a batch; each gives 3.7 images")
    add("--learning-rate", type=at_least(1e-9, float), default=1e-4, help="Adam's")
    add(
        "--samples-per-epoch",
        type=at_least(1, int),
        default=20224,
        help="images an epoch, at least; a fifth as many observations validate",
    )
    add("--seed", type=at_least(0, int), default=0, help="the same seed gives the same run on a machine")
    add(
        "--device",
        choices=["auto", "cpu", "cuda", "mps"],
        default="auto",
        help="auto: an NVIDIA GPU, else Apple's, else the CPU",
    )
    add = parser.add_argument_group("observations").add_argument
    add("--throttle-threshold", type=float, default=0.25, help="rows with less throttle are dropped")
    add("--side-correction", type=float, default=0.2, help="added to the left camera's steering, taken off the right's")
    add("--strict", action="store_true", help="stop at an unusable row, instead of leaving it out")
    add(
        "--robust",
        action="store_true",
        help="instead of dropping rows off throttle, resampling and side cameras: learn to come back onto the lane's "
        "centre, from frames seen from beside it, in "
        + ", ".join(f"--{name.replace('_', '-')} {value:g}" for name, value in ROBUST.items())
        + " unless given",
    )
    add = parser.add_argument_group("output").add_argument
    add("--output", default="model.pt", help="the model; all else is written beside it")
    add(
        "--resume",
        action="store_true",
        help="go on from the output's -resume.pt, with that run's arguments; --epochs may be raised",
    )
    arguments = parser.parse_args(argv)
    absent = object()  # argparse sets a default only where a namespace has nothing yet
    given = vars(parser.parse_args(argv, argparse.Namespace(**dict.fromkeys(vars(arguments), absent))))
    given = {
        name: value
        for name, value in given.items()
        if value is not absent and (name != "recordings" or value is not parser.get_default(name))
    }  # argparse sets a list's in any case
    if arguments.robust:
        for name in {"throttle_threshold", "side_correction"} & given.keys():
            parser.error(f"--{name.replace('_', '-')} is the recipe's; --robust does without it")
        vars(arguments).update({name: value for name, value in ROBUST.items() if name not in given})
    return arguments, given


def at_least(least, kind):
    """A type for argparse: a number of this kind, not below the least."""

    def number(text: str):
        value = kind(text)
        if not least <= value < float("inf"):
            raise argparse.ArgumentTypeError(f"{text} is not a number from {least} up")
        return value

    number.__name__ = kind.__name__
    return number


def model_files(output: str) -> tuple[Path, Path, Path]:
    """For model.pt: itself, the last epoch's; model-best.pt; and model-resume.pt, which --resume goes on from."""
    path = Path(output)
    return path, path.with_stem(f"{path.stem}-best"), path.with_stem(f"{path.stem}-resume")


def load_resumed(arguments: argparse.Namespace, given: dict) -> dict | None:
    """The checkpoint to go on from, its run's arguments taken over; None to begin. Raises ModelError."""
    *_, path = model_files(arguments.output)
    if not arguments.resume:
        return None
    if not path.exists():
        print(f"{path}: nothing to resume yet; the run begins")
        return None
    saved = load_checkpoint(path)
    if "training" not in saved:
        raise ModelError(f"{path}: holds no state of a run; name the run's --output")
    free = ("recordings", "epochs", "device", "output", "strict", "resume")  # other recordings are found out later
    for name, value in saved["arguments"].items():
        if name in given and name not in free and given[name] != value:
            raise ModelError(
                f"{path}: was begun with --{name.replace('_', '-')} {value}, not {given[name]}; "
                "leave it out, or begin anew without --resume"
            )
        if name not in given:
            setattr(arguments, name, value)
    return saved
