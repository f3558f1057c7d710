"""`python -m cloning.browse` as a process, for the tests."""

import json
import os
import signal
import subprocess
import sys
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import warm
from commands import ROOT
from drive_process import ask, found

from cloning.browse.analyses import LANE, Analysis, Result, stamp, write_result
from cloning.browse.library import Library
from cloning.recordings.log import read_recording
from cloning.road.track import Track
from cloning.training.run_files import RunFiles


class Browse:
    """A server of recordings, in a process of its own."""

    def __init__(self, *arguments, modules: Path = ROOT, stderr: IO[str] | None = None):
        """modules: a folder of modules that go before the installed ones; stderr: a file for its log."""
        command = [sys.executable, "-m", "cloning.browse", *map(str, arguments), "--port", "0"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(modules), str(ROOT)])}
        start = warm.Popen if modules == ROOT else subprocess.Popen  # the warm process has loaded the installed ones
        self.process = start(command, stdout=subprocess.PIPE, stderr=stderr, text=True, env=environment)
        assert self.process.stdout
        with self.process.stdout as lines:
            self.port = int(found(r"http://127.0.0.1:(\d+)/", lines.readline()))
        self.base = f"http://127.0.0.1:{self.port}/"

    def ask(self, path: str, *arguments, **headers: str) -> tuple[int, bytes, dict]:
        return ask(self.port, path, *arguments, **headers)

    def answer(self, path: str, *arguments) -> Any:
        """The JSON of an answer that is no error."""
        status, data, _ = self.ask(path, *arguments)
        assert status == 200, data
        return json.loads(data)

    def refuses(self, words: str, path: str, *arguments, status: int = 409) -> None:
        """Check that an error is answered, with these words."""
        answered, data, _ = self.ask(path, *arguments)
        assert answered == status and words in json.loads(data)["message"], data

    def recordings(self) -> dict[str, str]:
        """Where each recording is, by its folder's name."""
        return {Path(each["folder"]).name: f"/recordings/{each['id']}" for each in self.answer("/recordings")}

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
        assert server.process.wait(30) == 128 + signal.SIGINT


@contextmanager
def opened(folder: Path, *models: Path):
    """A recording as the page shows it, without a server."""
    with closing(Library([folder], list(models))) as library:
        yield library[next(iter(library.recordings))]


def written(folder: Path, analysis: Analysis, columns: dict[str, np.ndarray], **about: object) -> None:
    """As if a recording had been analysed already, which takes seconds."""
    result = Result(read_recording(folder).images[:, 0], columns, {"unusable": 0, "first_unusable": [], **about})
    write_result(folder, analysis, stamp(folder, analysis), result)


def placed(folder: Path, offset: np.ndarray) -> None:
    """As if the lane had been analysed already; offset: float (n,), m."""
    track = Track("lake")
    x, y = track.points[100 : 100 + len(offset), :2].T
    road = {"name": "lake", "direction": "ccw", "outline": track.points[:, :2].tolist()}
    label = -offset / 10
    written(folder, LANE, {"offset": offset, "label": label, "x": x, "y": y, "road": 0 * label}, roads=[road])


def steered(folder: Path, model: Path) -> None:
    """As if a model's steering, 0.1, were known already."""
    steering = np.full(len(read_recording(folder)), 0.1)
    written(folder, Analysis("steering", str(model)), {"steering": steering})


def replayed(folder: Path, model: Path, limit: float, offset: np.ndarray, where: list) -> None:
    """As if a model had driven the recording beside the human's path; offset: float (n,), m; where: as in a result."""
    still = np.zeros(len(offset))
    columns = {"offset": offset, "human": still, "right": offset, "yaw": still, "steering": -offset, "line": still}
    metrics = {"autonomy_percent": 90.0, "interventions": len(where), "distance_mean_m": 0.25, "distance_p95_m": 0.48}
    unknown = [[int(read_recording(folder).images[7, 0]), 5, "not driven"]]
    known = {"by_reference": {"lane_centre": metrics}, "rows_placed": len(offset), "unknown": unknown}
    driven = {"mean_speed_mph": 15.0, "steering_roughness_per_s": 0.2, "by_lane": len(offset) - 3}
    about = {**metrics, **known, **driven, "human_mean_m": 0.0, "where": where}
    written(folder, Analysis("replay", str(model), limit), columns, **about)


def written_run(folder, finished: int, images: int, epochs=4, losses=(0.5, 0.4, 0.3, 0.2), drifts=()) -> RunFiles:
    """A run of epochs of 1000 images at 100 images/s, as model.py writes it; drifts: none as an earlier version."""
    files = RunFiles(str(folder / "model.pt"))
    files.pictures.mkdir(parents=True)
    options = {"epochs": epochs, "samples_per_epoch": 1000, "batch_size": 10, "robust": True, "recordings": ["lake"]}
    files.arguments.write_text(json.dumps(options), encoding="utf-8")
    drift = [f",{metres}" for metres in drifts] or [""] * len(losses)
    rows = [f"{n + 1},1000,12.5,{loss},{loss}{drift[n]}" for n, loss in enumerate(losses)]
    header = "epoch,images,seconds,loss,val_loss" + ",val_drift" * bool(drifts)
    files.log.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    progress = {"run": "a", "finished": finished, "batches": finished * 100 + images // 10, "images": images}
    progress |= {"seconds": images / 100, "loss": 0.25 if images else None}
    progress |= {"trail_every": 25, "trail": [0.5 - 0.01 * n for n in range((finished * 1000 + images) // 250)]}
    files.progress.write_text(json.dumps(progress), encoding="utf-8")
    for observations in (0, 1200, 6400):
        for name in ("LRC_", "augmented-"):
            (files.pictures / f"training_generator_{name}{observations}.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    return files


# The next answer whose address has this part comes when `late.go` is called.
LATE = """const own = fetch; late = {asked: 0}; fetch = async (...what) => {
    const answer = await own(...what);
    if (what[0].includes("%s") && !late.asked++) await new Promise(go => late.go = go);
    return answer;
}; 0"""


def asks_why(page, *keys: str) -> None:
    """Press keys, and wait until the page asks for the reason of a cut."""
    page.press(*keys)
    page.wait("document.querySelector('#reason[open]')")


def at(page, row: int) -> None:
    """Wait until the page shows a row of the sample recording."""
    page.shows("#where", f"frame {row + 1} of 60")
