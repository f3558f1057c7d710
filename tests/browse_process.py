"""`python -m cloning.browse` as a process, for the tests."""

import http.client
import json
import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from conftest import HERE

from cloning.browse.analyses import LANE, Result, stamp, write_result
from cloning.recordings.log import read_recording
from cloning.road.track import Track


class Browse:
    """A server of recordings, in a process of its own."""

    def __init__(self, *arguments):
        command = [sys.executable, "-m", "cloning.browse", *map(str, arguments), "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **HERE})
        self.said = self.process.stdout.readline()
        self.port = int(re.search(r"http://127.0.0.1:(\d+)/", self.said)[1])
        self.base = f"http://127.0.0.1:{self.port}/"

    def ask(self, path: str, method: str = "GET", body: object = None, **headers) -> tuple[int, bytes, dict]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        data = None if body is None else json.dumps(body)
        headers = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request(method, path, data, {"Content-Type": "application/json", **headers})
        answer = connection.getresponse()
        try:
            return answer.status, answer.read(), dict(answer.headers)
        finally:
            connection.close()

    def get(self, path: str) -> object:
        status, data, _ = self.ask(path)
        assert status == 200, data
        return json.loads(data)

    def recordings(self) -> dict[str, str]:
        """Where each recording is, by its folder's name."""
        return {Path(each["folder"]).name: f"/recordings/{each['id']}" for each in self.get("/recordings")}


@contextmanager
def browsing(*arguments):
    server = Browse(*arguments)
    try:
        yield server
    finally:
        server.process.send_signal(signal.SIGINT)
        assert server.process.wait(30) == 0
        server.process.stdout.close()


def placed(folder: Path, offset: np.ndarray) -> None:
    """As if the lane had been analysed already, which takes seconds; offset: float (n,), m."""
    recording, track = read_recording(folder), Track("lake")
    points = track.points[100 : 100 + len(recording), :2].astype(np.float32)
    columns = {"offset": offset.astype(np.float32), "x": points[:, 0], "y": points[:, 1], "road": np.zeros(len(offset))}
    found = {"name": "lake", "direction": "ccw", "outline": track.points[:, :2].tolist()}
    about = {"roads": [found], "longest": 60, "unusable": 0, "first_unusable": []}
    write_result(folder, LANE, stamp(folder, LANE), Result(recording.images[:, 0], columns, about))
