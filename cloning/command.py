"""The command of an installed project: `behavioral-cloning train`, `drive` and so on, like the scripts of a clone.

`behavioral-cloning train --help` shows the options of `python model.py`, and so on. `cloning.scripts` has the scripts.
"""

import sys

from cloning.base import program

COMMANDS = {  # name: its module, the command of a clone, what it does
    "train": ("cloning.scripts.model", "python model.py", "train a network on recordings"),
    "drive": ("cloning.scripts.drive", "python drive.py", "let a network drive the simulator"),
    "video": ("cloning.scripts.video", "python video.py", "make a film of a drive"),
    "simulator": ("simulator.__main__", "python -m simulator", "the stand-in simulator"),
    "replay": ("simulator.__main__", "python -m simulator replay", "let a network drive recordings"),
    "browse": ("cloning.browse.__main__", "python -m cloning.browse", "look at recordings and training runs"),
    "report": ("cloning.report.__main__", "python -m cloning.report", "write a training run's report"),
    "export": ("cloning.network.export", "python -m cloning.network.export", "write a network as ONNX"),
    "lerobot": ("cloning.lerobot.__main__", "python -m cloning.lerobot", "to and from data sets of LeRobot"),
}
USAGE = "usage: behavioral-cloning COMMAND ... | --version\n\n" + "\n".join(
    f"  {name:10} {does}: {clone}" for name, (_, clone, does) in COMMANDS.items()
)


def main() -> None:
    """Run the command that the arguments name."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name == "--version":
        from importlib.metadata import version  # here, because it takes 20 ms

        print("behavioral-cloning", version("behavioral-cloning"))
        sys.exit(program.DONE)
    if name not in COMMANDS:
        print(USAGE, file=sys.stdout if name in ("-h", "--help") else sys.stderr)
        sys.exit(program.DONE if name in ("-h", "--help") else program.FAILED)
    sys.argv = [f"behavioral-cloning {name}", *sys.argv[1 if name == "replay" else 2 :]]
    program.installed = {clone: f"behavioral-cloning {command}" for command, (_, clone, _) in COMMANDS.items()}
    program.end_on_interrupt(f"behavioral-cloning {name}")
    from importlib import import_module  # here, so that nothing delays `end_on_interrupt`

    program.run(import_module(COMMANDS[name][0]).main)
