"""Record laps that the expert drives, faster than real time."""

import functools
import multiprocessing
import os
import signal
import threading
from collections import deque
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import NamedTuple

from panda3d.core import TransformState
from tqdm import tqdm

from cloning.base.cores import threads
from cloning.base.errors import SimulatorError
from cloning.recordings.writer import DEFAULT_START, RecordingWriter, SampleClock
from cloning.road.motion import MPH, TOP_SPEED_MPH
from cloning.road.track import Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.expert import Expert, Recovery
from simulator.run import Run
from simulator.world import Scene

MAX_RENDERERS = 3  # processes; each uses one core and 50 MB


class Row(NamedTuple):
    """A row of the recording whose images are being rendered; its fields: see `RecordingWriter.add`."""

    time: float
    images: Future[list[bytes]]
    steering: float
    throttle: float
    brake: float
    speed: float
    lane: tuple[float, float]


def _start_renderer() -> None:
    """Make a rendering process ignore Ctrl-C, and end together with the recording process, even if that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@functools.cache
def _cameras(track: str, look: int) -> Cameras:
    return Cameras(Scene(scenery.build(track, look)))


def _render(track: str, look: int, transform: TransformState) -> list[bytes]:
    """Return the three cameras' JPEGs, which depend on the car's pose alone; runs in a rendering process."""
    return [jpeg(frame) for frame in _cameras(track, look).frames(transform)]


def write_row(recording: RecordingWriter, cameras: Cameras, run: Run) -> None:
    """Render the three cameras, and add a row of the run's present state to a recording. Raises RecordingError."""
    images = [jpeg(frame) for frame in cameras.frames(run.car.node.get_transform())]
    recording.add(run.time, images, run.steering, *run.throttle_and_brake, run.speed_mph, run.lane)


def record(
    folder: str | Path,
    track: Track,
    laps: float,
    speed: float = TOP_SPEED_MPH,
    seed: int = 0,
    look: int = 0,
    recovery: bool = False,
) -> tuple[Run, int]:
    """Record the expert's laps into a new folder; return the run and the number of rows.

    speed: set speed in mph; recovery: record only returns from the road's edges. The dates in the images' names depend
    on the seed, not on today's date, so that the same arguments give the same files. Raises RecordingError if the
    folder cannot be written or holds a recording, SimulatorError if a rendering process is killed.
    """
    run = Run(track)
    run.car.speed_limit = speed * MPH
    expert = (Recovery if recovery else Expert)(track, seed, speed * MPH)
    clock = SampleClock()
    renderers = min(MAX_RENDERERS, threads())
    with (
        RecordingWriter(folder, DEFAULT_START + timedelta(days=seed % 10_000)) as recording,
        ProcessPoolExecutor(renderers, initializer=_start_renderer) as pool,
        tqdm(total=round(laps * track.length), unit="m", unit_scale=True, disable=None) as bar,
    ):
        pending: deque[Row] = deque()

        def write() -> None:
            row = pending.popleft()
            recording.add(row.time, row.images.result(), row.steering, row.throttle, row.brake, row.speed, row.lane)

        try:
            while run.travelled < laps * track.length:
                run.step(*expert.drive(run))
                if clock.due(run.time) and expert.recordable:
                    images = pool.submit(_render, track.name, look, run.car.node.get_transform())
                    row = Row(run.time, images, run.steering, *run.throttle_and_brake, run.speed_mph, run.lane)
                    pending.append(row)
                    if len(pending) > 2 * renderers:
                        write()
                    bar.update(round(max(0.0, run.travelled)) - bar.n)
            while pending:
                write()
        except BrokenExecutor as error:
            raise SimulatorError(
                f"{folder}: a rendering process was killed, perhaps for lack of memory; "
                f"the {recording.rows} rows recorded before are complete"
            ) from error
    return run, recording.rows
