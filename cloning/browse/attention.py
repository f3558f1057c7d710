"""What a model looks at on a picture, computed by a process of its own: PyTorch alone takes 250 MB."""

import os
import subprocess
import sys
import threading
from typing import IO

from cloning.base.errors import ModelError

COMMAND = (sys.executable, "-m", "cloning.browse.attend")


def send(pipe: IO[bytes], first: bytes, second: bytes) -> None:
    """Write two byte strings. Raises BrokenPipeError."""
    pipe.write(b"%d %d\n" % (len(first), len(second)) + first + second)
    pipe.flush()


def receive(pipe: IO[bytes]) -> tuple[bytes, bytes]:
    """Read two byte strings. Raises EOFError."""
    if not (sizes := pipe.readline()):
        raise EOFError
    first, second = map(int, sizes.split())
    return pipe.read(first), pipe.read(second)


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
            raise ModelError(message.decode())
        return png

    def close(self) -> None:
        """End the process."""
        self.closed = True
        if self.process:
            self.process.kill()
            self.process.wait()

    def _ask(self, jpeg: bytes, model: str) -> tuple[bytes, bytes] | None:
        """Return the process's message, empty without an error, and its PNG; None if it has ended. Raises OSError."""
        if self.closed:
            return None
        if not self.process or self.process.poll() is not None:
            self.process = subprocess.Popen(COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self.process.stdin and self.process.stdout
        try:
            send(self.process.stdin, jpeg, os.fsencode(model))
            return receive(self.process.stdout)
        except (BrokenPipeError, EOFError):
            self.process.wait()
            return None
