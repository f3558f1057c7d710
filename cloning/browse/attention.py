"""What a model looks at on a picture, computed by a process of its own: PyTorch alone takes 250 MB."""

import pickle
import subprocess
import threading

from cloning.base.errors import ModelError
from cloning.base.processes import PYTHON, environment

COMMAND = (*PYTHON, "-m", "cloning.browse.attend")


class Attention:
    """Asks the process, and starts it when it is needed; it ends itself when nothing has been asked for a while."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.one_at_a_time = threading.Lock()
        self.closed = False

    def png(self, jpeg: bytes, model: str) -> bytes:
        """Return a PNG to lay over a frame; model: its file. Blocks until it is there. Raises ModelError, OSError."""
        with self.one_at_a_time:
            answer = self._ask(jpeg, model) or self._ask(jpeg, model)  # the process may just have ended itself
        if not answer:
            raise ModelError(f"{model}: cannot show what it looks at: the process that computes it has ended")
        message, png = answer
        if message:
            raise ModelError(message)
        return png

    def close(self) -> None:
        """End the process."""
        self.closed = True
        if self.process:
            self.process.kill()
            self.process.wait()

    def _ask(self, jpeg: bytes, model: str) -> tuple[str, bytes] | None:
        """Return the process's message, empty without an error, and its PNG; None if it has ended. Raises OSError."""
        if self.closed:
            return None
        if not self.process or self.process.poll() is not None:
            pipe, env = subprocess.PIPE, environment()
            self.process = subprocess.Popen(COMMAND, stdin=pipe, stdout=pipe, env=env)
        assert self.process.stdin and self.process.stdout
        try:
            pickle.dump((jpeg, model), self.process.stdin)
            self.process.stdin.flush()
            return pickle.load(self.process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):  # Windows has other errors than BrokenPipeError
            self.process.wait()
            return None
