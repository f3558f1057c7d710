"""Python commands in children of a warm process, which has loaded the libraries: a start costs 0.1 instead of 2 to 4 s.

`run` and `Popen` take a command that begins with sys.executable, as those of subprocess do. A run of pytest has one
process, `python tests/warm.py`, that loads the libraries, and never uses them, once a test wants it. It forks a server
for each worker of pytest, and that a child for each command: with the command's own working folder, environment, input
and outputs. A command that looks at how libraries are loaded, at its memory or at itself in the list of processes, or
whose end is tested, needs a process of its own, from subprocess.
"""

import atexit
import contextlib
import functools
import gc
import importlib
import json
import multiprocessing.connection
import os
import runpy
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import types
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Any

LIBRARIES = (
    *("torch", "torch._dynamo", "numpy", "cv2", "av", "tqdm", "PIL.Image", "PIL.PngImagePlugin"),
    *("scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.sparse.linalg", "scipy.spatial"),
    *("matplotlib.backends.backend_agg", "matplotlib.figure", "matplotlib.pyplot", "panda3d.core", "multiprocessing"),
    *("engineio.async_drivers.eventlet", "socketio", "eventlet.websocket", "eventlet.wsgi", "flask", "wsproto"),
)
ADDRESS = "WARM_PROCESS"  # the variable of the environment with the socket's path
FORKS = sys.platform == "linux"  # elsewhere there is no fork, or libraries do not survive it
Command = Sequence[str | os.PathLike[str]]

# ----------------------------------------------------------------------------------------------------------------------
# In the warm process


def main(listener: socket.socket, lifeline: socket.socket) -> dict[str, Any] | None:
    """Fork a server for each worker of pytest that connects, until pytest ends; return a request in a child of it."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the servers
    loaded = False
    while lifeline not in multiprocessing.connection.wait([listener, lifeline]):
        connection = listener.accept()[0]
        if not loaded:
            load()
            loaded = True
        if not os.fork():
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            listener.close()
            lifeline.close()
            return serve(connection)
        connection.close()
    return None


def load() -> None:
    """Import, but never use: a library that has started threads would not survive a fork."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # eventlet advises against using it
        for name in LIBRARIES:
            importlib.import_module(name)
    gc.freeze()  # the children then share more of their memory


def serve(pytest: socket.socket) -> dict[str, Any] | None:
    """Fork a child for each command; return its request in the child, None at the end of pytest."""
    while True:
        data, files, _, _ = socket.recv_fds(pytest, 1 << 20, 3)
        if not data:
            return None
        request = json.loads(data)
        answer = 0
        if "prepare" in request:
            exec(request["prepare"], {})
            gc.freeze()
        elif "wait" in request:
            answer = os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1])
        elif not (answer := os.fork()):
            for number, file in enumerate(files):
                os.dup2(file, number)
            files += [pytest.detach()]
        for file in files:
            os.close(file)
        if not answer and "command" in request:
            return request
        pytest.send(json.dumps(answer).encode())


def run_request(request: dict[str, Any]) -> None:
    """Run a command as Python does when it starts."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if request["session"]:
        os.setsid()
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", 1, errors="backslashreplace", closefd=False)
    sys.path[:1] = [request["cwd"], *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    run_command(request["command"])


def run_command(words: list[str]) -> None:
    """Run what stands behind `python` in a command: -m MODULE, -c CODE or a script, and their arguments."""
    first, *arguments = words
    if first == "-m":
        sys.argv = arguments
        runpy.run_module(arguments[0], run_name="__main__", alter_sys=True)
    elif first == "-c":
        sys.argv = ["-c", *arguments[1:]]
        main = sys.modules["__main__"] = types.ModuleType("__main__")
        exec(compile(arguments[0], "<string>", "exec"), main.__dict__)
    else:
        sys.argv = words
        sys.path[0] = str(Path(first).resolve().parent)
        runpy.run_path(first, run_name="__main__")


# ----------------------------------------------------------------------------------------------------------------------
# In the test


def start() -> None:
    """Start the warm process of this run of pytest, which ends with it; only this user reaches its socket."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder)
    os.environ[ADDRESS] = os.path.join(folder, "warm")
    ours, theirs = socket.socketpair()
    atexit.register(ours.close)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener, theirs:
        listener.bind(os.environ[ADDRESS])
        listener.listen()
        files = [listener.fileno(), theirs.fileno()]
        subprocess.Popen(
            [sys.executable, __file__, *map(str, files)],
            env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=files,
        )


class WarmProcess:
    """A server of the warm process, as the tests see it; it ends with the worker of pytest."""

    def __init__(self, prepare: str) -> None:
        """prepare: Python code that it runs first."""
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.connect(os.environ[ADDRESS])
        self.lock = threading.Lock()
        atexit.register(self.socket.close)
        self.ask({"prepare": prepare})

    def ask(self, request: dict[str, Any], files: Sequence[int] = ()) -> int:
        """Send a request with files; return the answer: a process's id or exit status."""
        with self.lock:
            socket.send_fds(self.socket, [json.dumps(request).encode()], files)
            return int(self.socket.recv(100))


warm_process = functools.cache(WarmProcess)


class Child:
    """A command in a child of the warm process, with those of subprocess.Popen's parameters and methods in use here."""

    def __init__(
        self,
        command: Command,
        *,
        cwd: str | os.PathLike[str] | None = None,
        env: Mapping[str, str] | None = None,
        stdin: Any = None,
        stdout: Any = None,
        stderr: Any = None,
        text: bool = False,
        start_new_session: bool = False,
        creationflags: int = 0,  # Windows's
        prepare: str = "",
    ):
        """prepare: each code has a server of its own, see `WarmProcess`."""
        self.args = command
        self.returncode: int | None = None
        python, *words = (os.fspath(word) for word in command)
        assert python == sys.executable, "the warm process is this Python"
        request = {
            "command": words,
            "cwd": os.path.abspath(cwd or "."),
            "env": dict(os.environ if env is None else env),
            "session": start_new_session,
        }
        streams: list[IO[Any] | None] = []
        files: list[int] = []
        for number, wanted in enumerate((stdin, stdout, stderr)):
            stream = None
            if wanted == subprocess.PIPE:
                reader, writer = os.pipe()
                theirs, ours = (reader, writer) if number == 0 else (writer, reader)
                stream = os.fdopen(ours, ("w" if number == 0 else "r") + ("" if text else "b"))
            elif wanted == subprocess.DEVNULL:
                theirs = os.open(os.devnull, os.O_RDWR)
            elif wanted is None:
                theirs = os.dup(number)  # pytest's own
            else:
                theirs = os.dup(wanted if isinstance(wanted, int) else wanted.fileno())
            streams.append(stream)
            files.append(theirs)
        self.stdin, self.stdout, self.stderr = streams
        self.warm = warm_process(prepare)
        self.pid = self.warm.ask(request, files)
        for file in files:
            os.close(file)
        self.ended = os.pidfd_open(self.pid)  # readable once the process has ended

    def wait(self, timeout: float | None = None) -> int:
        if self.returncode is None:
            if not multiprocessing.connection.wait([self.ended], timeout):
                assert timeout is not None
                raise subprocess.TimeoutExpired(self.args, timeout)
            os.close(self.ended)
            self.returncode = self.warm.ask({"wait": self.pid})
        return self.returncode

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[Any, Any]:
        """The rest of its output, once it has ended."""
        with ThreadPoolExecutor() as pool:
            outputs = [pool.submit(stream.read) if stream else None for stream in (self.stdout, self.stderr)]
            try:
                self.wait(timeout)
            except subprocess.TimeoutExpired:
                self.kill()
                raise
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream:
                stream.close()
        out, errors = [output.result() if output else None for output in outputs]
        return out, errors


Process = subprocess.Popen[Any] | Child


def Popen(command: Command, **more: Any) -> Process:
    """As subprocess.Popen; with a preexec_fn, which cannot be sent, in a process of its own."""
    return Child(command, **more) if FORKS and "preexec_fn" not in more else subprocess.Popen(command, **more)


def run(
    command: Command, *, capture_output: bool = False, check: bool = False, timeout: float | None = None, **more: Any
) -> subprocess.CompletedProcess[Any]:
    """As subprocess.run."""
    if capture_output:
        more |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = Popen(command, **more)
    out, errors = process.communicate(timeout=timeout)
    assert process.returncode is not None
    done = subprocess.CompletedProcess(command, process.returncode, out, errors)
    if check:
        done.check_returncode()
    return done


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for pytest
    if request := main(*(socket.socket(fileno=int(number)) for number in sys.argv[1:])):
        run_request(request)
        if threading.active_count() == 1:  # to take the interpreter apart takes 0.3 s
            atexit._run_exitfuncs()
            sys.stdout.flush()
            os._exit(0)
