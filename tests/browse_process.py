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
import warm
from commands import ROOT

from cloning.browse.analyses import LANE, Analysis, Result, stamp, write_result
from cloning.recordings.log import read_recording
from cloning.road.track import Track
from cloning.training.run_files import RunFiles


class Browse:
    """A server of recordings, in a process of its own."""

    def __init__(self, *arguments, modules: Path = ROOT):
        """modules: a folder of modules that go before the installed ones."""
        command = [sys.executable, "-m", "cloning.browse", *map(str, arguments), "--port", "0"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(modules), str(ROOT)])}
        start = warm.Popen if modules == ROOT else subprocess.Popen  # the warm process has loaded the installed ones
        self.process = start(command, stdout=subprocess.PIPE, text=True, env=environment)
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

    def hash(self, name: str) -> str:
        """The page's address of a recording, after the server's; name: its folder's."""
        return self.recordings()[name].replace("/recordings", "#")


@contextmanager
def browsing(*arguments, **more):
    server = Browse(*arguments, **more)
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


def steered(folder: Path, model: Path) -> None:
    """As if a model's steering, 0.1, were known already."""
    recording, analysis = read_recording(folder), Analysis("steering", str(model))
    columns = {"steering": np.full(len(recording), 0.1, np.float32)}
    about = {"unusable": 0, "first_unusable": []}
    write_result(folder, analysis, stamp(folder, analysis), Result(recording.images[:, 0], columns, about))


def replayed(folder: Path, model: Path, limit: float, offset: np.ndarray, where: list) -> None:
    """As if a model had driven the recording beside the human's path; offset: float (n,), m; where: as in a result."""
    recording, replay = read_recording(folder), Analysis("replay", str(model), limit)
    still = np.zeros(len(offset))
    columns = {"offset": offset, "human": still, "right": offset, "yaw": still, "steering": -offset, "line": still}
    about = {"autonomy_percent": 90.0, "interventions": len(where), "distance_mean_m": 0.25, "distance_p95_m": 0.48,
             "human_mean_m": 0.0, "where": where, "by_lane": len(offset)}  # fmt: skip
    write_result(folder, replay, stamp(folder, replay), Result(recording.images[:, 0], columns, about))


def written_run(folder, finished: int, images: int, epochs: int = 4, losses=(0.5, 0.4, 0.3, 0.2)) -> RunFiles:
    """A run of epochs of 1000 images at 100 images/s, as model.py writes it."""
    files = RunFiles(str(folder / "model.pt"))
    files.pictures.mkdir(parents=True)
    options = {"epochs": epochs, "samples_per_epoch": 1000, "batch_size": 10, "robust": True, "recordings": ["lake"]}
    files.arguments.write_text(json.dumps(options), encoding="utf-8")
    rows = [f"{n + 1},1000,12.5,{loss},{loss}" for n, loss in enumerate(losses)]
    files.log.write_text("\n".join(["epoch,images,seconds,loss,val_loss", *rows]) + "\n", encoding="utf-8")
    told = {"run": "a", "finished": finished, "batches": finished * 100 + images // 10, "images": images,
            "seconds": images / 100, "loss": 0.25 if images else None}  # fmt: skip
    files.progress.write_text(json.dumps(told), encoding="utf-8")
    for number in (0, 1200, 6400):
        for kind in ("LRC_", "augmented-"):
            (files.pictures / f"training_generator_{kind}{number}.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    return files
