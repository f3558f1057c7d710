"""Show recordings in a browser, play them, and cut stretches from them; training and replays leave these out.

    python -m cloning.browse                                 # the recordings below data/, and the run in this folder
    python -m cloning.browse data/lake-ccw data/jungle       # these recordings
    python -m cloning.browse data --model model.pt           # also show how a model would steer, and let it drive
    python -m cloning.browse --run runs/a runs/b             # only the training runs that write to these folders

A cut is a line in excluded.csv beside the recording's driving_log.csv, which is never changed.
"""

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("browse")

import argparse
from pathlib import Path

from cloning.base.arguments import MAX_PORT, command_line, number
from cloning.base.errors import UserError
from cloning.base.outputs import plural
from cloning.browse.library import Library
from cloning.browse.page import create_app
from cloning.browse.runs import Runs
from cloning.network import FORMAT
from cloning.server import terminal
from cloning.server.site import BROWSE_HOST, BROWSE_PORT

MAX_BODY = 1 << 22  # bytes of a request: 30,000 cuts


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line; arguments: those of this process if None."""
    status = "Exit status: 130 after Ctrl-C, 2 if the server could not start."
    parser = command_line("python -m cloning.browse", __doc__, status)
    add = parser.add_argument
    add("recordings", nargs="*", metavar="FOLDER", help="recordings, or folders of recordings (default: data)")
    models = "show the steering of these models"
    add("--model", nargs="+", type=Path, default=[], metavar="model.pt", help=models)
    runs = "folders into which model.py writes (default: the current one); alone, without recordings"
    add("--run", nargs="+", type=Path, metavar="FOLDER", help=runs)
    port = "port to listen on, on this machine only (default %(default)s; 0: any free one)"
    add("--port", type=number(int, 0, MAX_PORT), default=BROWSE_PORT, help=port)
    return parser.parse_intermixed_args(arguments)


def main() -> int:
    """Serve the page until Ctrl-C; return the exit status."""
    arguments = parse_arguments()
    try:
        from cloning.server import connections  # here, because it needs the socket libraries

        for model in arguments.model:
            if not model.is_file():
                raise UserError(f"{model}: no such model file; `python model.py` trains one")
            if FORMAT.encode() not in model.read_bytes():
                raise UserError(f"{model}: not a model of this project that steers; `python model.py` trains one")
        for folder in arguments.run or []:
            if not folder.is_dir():
                raise UserError(f"{folder}: no such folder; name one that `python model.py` writes to")
        given = [] if arguments.run and not arguments.recordings else arguments.recordings or ["data"]
        library, runs = Library(given, arguments.model), Runs(arguments.run or [])
        listener = connections.claim_port(BROWSE_HOST, arguments.port)
    except (UserError, OSError) as error:
        return program.failed(error)
    stopped = connections.noted_signals()
    stderr = terminal.log_to_stderr(program.name)
    count = len(library.recordings)
    shown = plural(count, "recording") if count else plural(len(arguments.run), "training run")
    print(f"{shown}. Open http://{BROWSE_HOST}:{listener.getsockname()[1]}/ in a browser. Ctrl-C ends.", flush=True)
    try:
        connections.serve(listener, create_app(library, runs), stopped, most=MAX_BODY)
    finally:
        library.close()
        stderr.finish()
    return 128 + stopped[0]


if __name__ == "__main__":
    program.run(main)
