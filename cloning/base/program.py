"""How a command prints and ends: its exit status, its last message, and Ctrl-C without a traceback at any moment.

A command imports this first, calls `end_on_interrupt` at once (for a tool, its package does), and `run` at the end of
its file. Its exit status is DONE, INCOMPLETE, FAILED, or 128 + the number of the signal that ended it (130 for Ctrl-C).
Until `end_on_interrupt`, Ctrl-C gives Python's traceback, so this loads nothing that Python has not loaded already.
"""

from __future__ import annotations

import os
import sys

if sys.hexversion < 0x30B0000:  # told before all that an older one does not understand
    version = ".".join(map(str, sys.version_info[:3]))
    print(
        f"Python 3.11 or later is needed, and {sys.executable} is Python {version}: "
        "name another, such as python3.12, or activate the environment",
        file=sys.stderr,
    )
    os._exit(2)

import _signal as signal  # type: ignore[import-not-found]  # `signal` loads for 3 ms, and `typing` for 5
import atexit
import gc
import time

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType, TracebackType
    from typing import NoReturn

    from cloning.base.errors import UserError

OWN_PACKAGES = ("cloning", "simulator", "tools")
PACKAGES = {"cv2": "opencv-python-headless", "PIL": "pillow", "direct": "panda3d", "socketio": "python-socketio"}
DONE = 0
INCOMPLETE = 1  # done, with a loss that was reported: frames left out of a film, a car that left the road
FAILED = 2  # not done: argparse's status for wrong arguments, and that of every other error the user can correct
NO_MEMORY = ("allocate", "out of memory", "start new thread")  # in a RuntimeError of torch or Python
ACTIVATE = r".venv\Scripts\activate" if sys.platform == "win32" else "source .venv/bin/activate"  # a clone's
PATIENCE = 0.5  # s that Ctrl-C waits for a library that is being loaded
name = "python"  # of the command, which begins its messages; this one if another program calls its `main`
installed: dict[str, str] = {}  # a clone's commands, such as python drive.py -> as the installed project calls them
end_at_once: Callable[[int, FrameType | None], None] | None = None  # the handler of `end_on_interrupt`
interrupted = False  # whether Ctrl-C has come in `main`
warned: set[str] = set()  # the messages of `warn_once`


def in_commands(text: str) -> str:
    """Return a text with the commands as the user starts them: `behavioral-cloning drive` for `python drive.py`."""
    for clone, command in installed.items():
        text = text.replace(clone, command)
    install = _pip_install() if "pip install" in text else ""
    return text if install in text else text.replace("pip install", install)  # another process may have replaced it


def _pip_install() -> str:
    """Return `pip install` for this environment: those of pipx and uv have no pip, and any other installs elsewhere."""
    if os.path.exists(os.path.join(sys.prefix, "pipx_metadata.json")):
        return f"pipx inject {os.path.basename(sys.prefix)}"
    try:
        with open(os.path.join(sys.prefix, "pyvenv.cfg"), encoding="utf-8") as settings:
            by_uv = "\nuv = " in settings.read()
    except OSError:  # no virtual environment
        by_uv = False
    return f'uv pip install --python "{sys.prefix}"' if by_uv else "pip install"


def failed(error: UserError | OSError | MemoryError) -> int:
    """Print an error as `PROGRAM: MESSAGE` to stderr and return the exit status."""
    from cloning.base.errors import message_of

    print(in_commands(f"{name}: {message_of(error)}"), file=sys.stderr)
    return FAILED


def warn_once(message: str) -> None:
    """Print a warning as `PROGRAM: MESSAGE` to stderr, unless it was printed before."""
    if message not in warned:
        warned.add(message)
        print(in_commands(f"{name}: {message}"), file=sys.stderr)


def end_on_interrupt(program: str, message: str = "stopped") -> None:
    """Name the command, and make Ctrl-C print this message and end the process at once, with status 130.

    An exception would not do: libraries that are interrupted while they load turn it into errors of their own. Also
    end it, with a sentence instead of a traceback, if a library is missing.
    """
    global name, end_at_once
    name = program
    gc.disable()  # until `run`: libraries leave no garbage while they load, and looking for it takes 0.2 s
    sys.excepthook = _tell
    os.environ.pop("MPLBACKEND", None)  # a notebook's, whose library may not be here; no command shows figures

    def stop(signal_number: int, _: FrameType | None) -> None:
        print(f"{program}: {message}", file=sys.stderr, flush=True)
        os._exit(128 + signal_number)

    # A shell has its background processes ignore Ctrl-C; leave it so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        end_at_once = stop
        signal.signal(signal.SIGINT, stop)


def _tell(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print an error that ends the process: a missing library in one sentence, others with their traceback."""
    library = str(error.name).partition(".")[0] if isinstance(error, ModuleNotFoundError) else None
    if library is None or library in OWN_PACKAGES:
        sys.__excepthook__(kind, error, trace)
        return
    remedy = f"`pip install {PACKAGES.get(library, library)}`"
    if not installed:
        activate = f"activate the environment, in the project's folder (`{ACTIVATE}`)"
        remedy = f"{activate}; where that does not help, {remedy}"
    print(in_commands(f"{name}: the library {library} is missing: {remedy}"), file=sys.stderr, flush=True)
    os._exit(FAILED)


def _interrupt(_: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt: at once, or when the library has loaded that is loading; after PATIENCE end the process.

    While they load, libraries turn an exception into errors of their own, or drop it.
    """
    global interrupted
    interrupted = True
    importing = None  # what imports the library
    while frame:
        before, frame = frame, frame.f_back
        if frame and before.f_code.co_filename == "<frozen importlib._bootstrap>":
            importing = frame
    if not importing:
        raise KeyboardInterrupt
    latest = time.monotonic() + PATIENCE

    def loaded(*_: object) -> NoReturn:
        sys.settrace(None)
        raise KeyboardInterrupt

    def loading(*_: object) -> None:
        if time.monotonic() > latest and end_at_once:
            end_at_once(signal.SIGINT, None)

    importing.f_trace, importing.f_trace_opcodes = loaded, True  # called before its next instruction
    sys.settrace(loading)


def run(main: Callable[[], int | None]) -> NoReturn:
    """Run a command's main function and end with its exit status; Ctrl-C raises KeyboardInterrupt only in `main`.

    Its UserError or OSError is told by `failed`. Characters that stdout cannot show, such as undecodable bytes of a
    file's name, are printed as escapes there. What is printed to a stream that was closed before (`>&-`) is lost.
    """
    import io  # not at the top: Python 3.14 has not loaded it already
    from contextlib import suppress

    gc.freeze()  # what is loaded stays: each search through it would halt all threads for 0.1 s
    gc.enable()
    nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # it stays open
    sys.stdout, sys.stderr = sys.stdout or nowhere, sys.stderr or nowhere
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")
    stop = signal.getsignal(signal.SIGINT)
    if callable(stop):
        signal.signal(signal.SIGINT, _interrupt)
    try:
        if "" in sys.argv[1:]:  # as a file's name it would be the current folder
            from cloning.base.errors import UserError  # not at the top: see the docstring above

            raise UserError("an argument is empty, as from a shell's variable that is not set; name it or leave it out")
        status = main()
    except BaseException as error:
        kept = error  # noqa: F841 - so that what it holds, such as a window half made, is not taken apart at the end
        signal.signal(signal.SIGINT, stop)
        from cloning.base.errors import UserError

        if interrupted or isinstance(error, KeyboardInterrupt):  # a library may have raised an error of its own for it
            with suppress(OSError):  # Ctrl-C has ended the reader of a pipe, too
                sys.stdout.flush()
            status = 128 + signal.SIGINT
            if callable(stop):
                stop(signal.SIGINT, None)
        elif isinstance(error, UserError | OSError):  # also of stdout: a full disk, or a pipe that nobody reads
            status = failed(error)
        elif isinstance(error, MemoryError) or (
            isinstance(error, RuntimeError) and any(words in str(error) for words in NO_MEMORY)
        ):
            status = failed(MemoryError(f"too little memory is free: {str(error) or 'MemoryError'}"))
        else:
            raise
    finally:
        signal.signal(signal.SIGINT, stop)
    leave(status)


def leave(status: int | None) -> NoReturn:
    """End the process with an exit status, None for 0, without taking apart the interpreter and its libraries.

    That takes 0.7 s once torch is loaded. Where other threads have work to end, the process ends as usual, and where
    somebody types Python, as in a notebook (`%run model.py`), it goes on.
    """
    import threading

    if sys.flags.interactive or hasattr(sys, "ps1"):
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.exit(status)
    if not all(thread.daemon or thread is threading.main_thread() for thread in threading.enumerate()):
        sys.exit(status)
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
    except OSError as error:
        print(f"stdout: {error.strerror}", file=sys.stderr)
        status = FAILED
    os._exit(status or 0)
