"""drive.py as a process, and requests to a server, for the tests."""

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import warm
from commands import HERE, ROOT

# What Ctrl-C sends; Windows sends it to a whole console, and Ctrl-Break to one process group.
STOP = getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT)


def found(pattern: str, text: str) -> str:
    """The first group of a pattern in a text that has it."""
    match = re.search(pattern, text)
    assert match, text
    return match[1]


def awaited(condition: Callable[[], Any], seconds: float = 60.0) -> Any:
    """Wait until a condition is true; return its value."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "it never came"
        time.sleep(0.02)
    return value


def ask(port: int, path: str, method: str = "GET", body: object = None, **headers: str) -> tuple[int, bytes, dict]:
    """A server's answer: status, body, headers. body: bytes, or what is sent as JSON."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
    more = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, data, {"Content-Type": "application/json", **more})
    answer = connection.getresponse()
    try:
        return answer.status, answer.read(), dict(answer.headers)
    finally:
        connection.close()


def live(port: int, query: str = "") -> dict:
    """The figures that drive.py's page is given first."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/live{query}", timeout=30) as events:
        return json.loads(events.readline()[6:])


class Process:
    """A drive.py process; first: Python code to run before it."""

    def __init__(self, *arguments, port=0, cwd=None, first=""):
        self.process: warm.Process = warm.Popen(
            [*script("drive.py", first), *map(str, arguments), "--port", str(port)],
            cwd=cwd,
            env={**os.environ, **HERE},
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )
        self.lines: list[str] = []
        self.listening = threading.Event()
        self.reader = threading.Thread(target=self._read)
        self.reader.start()
        assert self.listening.wait(120)
        self.port = int(found(r"Listening on [\d.]+:(\d+)", "".join(self.lines)))

    def _read(self):
        assert self.process.stderr
        with self.process.stderr as lines:
            for line in lines:
                self.lines.append(line)
                if "Watch at" in line:
                    self.listening.set()
        self.listening.set()

    def stop(self, number=STOP) -> int:
        if self.process.poll() is None:
            self.process.send_signal(number)
        code = self.process.wait(60)
        self.reader.join()
        return code

    def memory(self) -> float:
        """Resident MB; 0 where the system does not tell it like Linux."""
        status = Path(f"/proc/{self.process.pid}/status")
        return int(found(r"VmRSS:\s+(\d+)", status.read_text(encoding="utf-8"))) / 1024 if status.exists() else 0.0


def script(name: str, first: str = "") -> list[str]:
    """The command of a script at the top; first: Python code to run before it."""
    if not first:
        return [sys.executable, str(ROOT / name)]
    run = f"import runpy, sys; sys.argv = sys.argv[1:]\nrunpy.run_path({str(ROOT / name)!r}, run_name='__main__')"
    return [sys.executable, "-c", f"{first}\n{run}", name]


@contextmanager
def serving(*arguments, **more):
    process = Process(*arguments, **more)
    try:
        yield process
    finally:
        process.process.kill()
        process.stop()
