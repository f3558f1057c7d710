"""The command line of model.py: its options are fields of the recipe, of the run and of the process."""

import argparse
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from cloning.base.arguments import number
from cloning.base.errors import ModelError, UserError
from cloning.base.outputs import names_folder
from cloning.network.compute import DEVICES, is_available
from cloning.network.network import load_checkpoint
from cloning.recordings.format import DRIVING_LOG, PROBLEM_AREAS
from cloning.training.recipe import LIMITS, Recipe, option_name

MAX_SEED = 2**63 - 1  # torch takes no larger one
SAVE_SECONDS = 30.0  # between two saved states: the most work that a killed run loses


@dataclass(frozen=True)
class Run:
    """What belongs to a training run, and is saved with it."""

    recipe: Recipe
    recordings: tuple[str, ...] = ("data",)  # folders of recordings, or of folders with recordings
    seed: int = 0
    from_model: str = ""  # the model file with whose weights the run begins; "": random weights

    def saved(self) -> dict[str, Any]:
        """Return the run as plain values, for a checkpoint."""
        run = {"recordings": list(self.recordings), "seed": self.seed, "from_model": self.from_model}
        return {**run, "recipe": self.recipe.saved()}


@dataclass(frozen=True)
class Process:
    """What belongs to one process of a run: a run may be resumed with others."""

    output: str = "model.pt"  # the model file; all other files are written to its folder
    device: str = "auto"  # one of DEVICES
    strict: bool = False
    resume: bool = False
    save_seconds: float = SAVE_SECONDS  # between two saved states

    def check(self) -> None:
        """Raise UserError for an output or a device that can't be used."""
        if names_folder(self.output):
            raise UserError(f"--output {self.output}: is a folder; name the model file in it, such as model.pt")
        if self.device not in DEVICES or not is_available(self.device):
            raise UserError(f"--device {self.device}: torch finds no such GPU on this machine; leave the option out")


def given_by_program(run: Run) -> frozenset[str]:
    """Return the names of a run's and its recipe's fields: all, but `from_model` only if it names a model."""
    names = frozenset(item.name for kind in (Run, Recipe) for item in fields(kind))
    return names if run.from_model else names - {"from_model"}


class Command(NamedTuple):
    """What model.py is asked to do."""

    run: Run
    process: Process
    given: frozenset[str]  # names of the run's and recipe's fields that the user gave, and "robust"
    recipes: Mapping[str, Recipe]  # those that a checkpoint may have been trained by, by their names


# The options that set fields of the recipe, and those of them that have no effect with --robust.
FIGURES = {
    "epochs": "epochs in total; may be raised with --resume",
    "batch_size": "observations in a batch; each gives 3.7 images on average",
    "learning_rate": "learning rate of Adam or, with --robust, of Muon",
    "samples_per_epoch": "smallest number of images in an epoch; a fifth as many observations, at most 4,096, "
    "validate it",
    "throttle_threshold": "without --robust: drop rows with less throttle, 0 to 1",
    "side_correction": "without --robust: steering added to the label of left images, subtracted from right ones'",
    "repeats": f"how often a recording counts whose name ends in {' or '.join(PROBLEM_AREAS)}",
    "disturbed": "with --robust: share of the images in foul weather, or of a faulty camera",
}
REPORT_ONLY, ROBUST_ONLY = ("throttle_threshold", "side_correction"), ("disturbed",)


def parse(argv: list[str] | None, report: Recipe, robust: Recipe) -> Command:
    """Parse the command line, of this process if argv is None; an unusable argument ends it with status 2."""
    parser = build_parser(report, robust)
    values = vars(parser.parse_intermixed_args(argv))  # recordings may follow options
    given = frozenset(values)
    goes_on = values.get("from_model") and recipe_name(values["from_model"]) == robust.name
    recipe = robust if values.pop("robust", goes_on) else report
    for name in given.intersection(REPORT_ONLY if recipe is robust else ROBUST_ONLY):
        without = "with" if recipe is robust else "without"
        parser.error(f"{option_name(name)} has no effect {without} --robust; leave it out")
    recipe = replace(recipe, **{name: values.pop(name) for name in FIGURES if name in values})
    process = Process(**{name: values.pop(name) for name in ("output", "device", "strict", "resume") if name in values})
    if "recordings" in values:
        values["recordings"] = tuple(values["recordings"])
    try:
        process.check()
    except UserError as error:
        parser.error(str(error))
    return Command(Run(recipe, **values), process, given, {report.name: report, robust.name: robust})


def recipe_name(model: str) -> str | None:
    """Return the name of the recipe that trained a model file; None if the file does not tell, or can't be read."""
    with suppress(ModelError):  # `read_first_weights` tells of it later
        arguments = load_checkpoint(model).get("arguments")
        if isinstance(arguments, dict):
            earlier = "robust" if arguments.get("robust") is True else "report"  # of a version without recipes
            recipe = arguments.get("recipe", {"name": earlier})
            return recipe.get("name") if isinstance(recipe, dict) else None
    return None


def build_parser(report: Recipe, robust: Recipe) -> argparse.ArgumentParser:
    """Return the parser; it sets no defaults, which are the recipe's."""
    parser = argparse.ArgumentParser(
        description="Train NVIDIA's network to predict steering from recordings of the Udacity simulator.",
        epilog="The defaults are those of the report of Udacity's Behavioral Cloning project. "
        "Stop a run with Ctrl-C at any time; --resume continues it.",
        argument_default=argparse.SUPPRESS,
    )
    text = f"recordings, or folders with some at any depth; a recording is a folder with {DRIVING_LOG} (default: data)"
    parser.add_argument("recordings", nargs="*", help=text)
    add = parser.add_argument_group("recipe").add_argument
    differ = [name for name in FIGURES if getattr(report, name) != getattr(robust, name)]
    text = (
        "train for robustness rather than fidelity to the report: learn recovery steering from frames warped to "
        "other lateral offsets and headings; uses "
        f"{', '.join(f'{option_name(name)} {getattr(robust, name):g}' for name in differ)} unless these are given"
    )
    add("--robust", action=argparse.BooleanOptionalAction, help=text)
    for name, text in FIGURES.items():
        parse_value = number(type(getattr(report, name)), *LIMITS.get(name, ()))
        add(option_name(name), type=parse_value, help=f"{text} (default: {getattr(report, name)})")
    add = parser.add_argument_group("run").add_argument
    text = "on the same machine, the same seed repeats the same run (default: 0)"
    add("--seed", type=number(int, 0, MAX_SEED), help=text)
    text = "begin with the weights of this model file, and with --robust if it was trained so (default: random weights)"
    add("--from", dest="from_model", metavar="MODEL", help=text)
    text = "continue the run of this --output with its original arguments; begin a new run if there is none"
    add("--resume", action="store_true", help=text)
    add("--strict", action="store_true", help="fail if a row is unusable, instead of leaving it out")
    add("--output", help="model file; all other files are written to its folder (default: model.pt)")
    text = "cuda: an NVIDIA GPU; mps: Apple's GPU; auto: the first of cuda, mps and cpu that exists (default: auto)"
    add("--device", choices=DEVICES, help=text)
    return parser
