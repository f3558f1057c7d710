"""The command of an installed project: `behavioral-cloning train`, `drive` and so on, like the scripts of a clone.

`behavioral-cloning train --help` shows the options of `python model.py`, and so on. `cloning.scripts` is where a wheel
has the scripts.
"""

import functools
import importlib
import sys

from cloning.base import program

COMMANDS = {
    "train": ("cloning.scripts.model", "train a network on recordings: python model.py"),
    "drive": ("cloning.scripts.drive", "let a network drive the simulator: python drive.py"),
    "video": ("cloning.scripts.video", "make a film of a drive: python video.py"),
    "simulator": ("simulator.__main__", "the stand-in simulator: python -m simulator"),
    "replay": ("simulator.__main__", "let a network drive recordings: python -m simulator replay"),
    "browse": ("cloning.browse.__main__", "look at recordings and training runs: python -m cloning.browse"),
    "report": ("cloning.report.__main__", "write a training run's report: python -m cloning.report"),
    "export": ("cloning.network.export", "write a network as ONNX: python -m cloning.network.export"),
}
USAGE = "usage: behavioral-cloning COMMAND …\n\n" + "\n".join(
    f"  {name:10} {does}" for name, (_, does) in COMMANDS.items()
)


def start(module: str) -> int | None:
    """Run a module's `main`; return its exit status."""
    try:
        with program.loading():
            main = importlib.import_module(module).main
        return main()
    except ModuleNotFoundError as error:  # of an extra of pyproject.toml
        print(f"behavioral-cloning: {program.missing_library(error)}", file=sys.stderr)
        return program.FAILED


def main() -> None:
    """Run the command that the arguments name."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in COMMANDS:
        print(USAGE, file=sys.stdout if name in ("-h", "--help") else sys.stderr)
        sys.exit(program.DONE if name in ("-h", "--help") else program.FAILED)
    sys.argv = [f"behavioral-cloning {name}", *sys.argv[1 if name == "replay" else 2 :]]
    program.end_on_interrupt(f"behavioral-cloning {name}")
    program.run(functools.partial(start, COMMANDS[name][0]))
