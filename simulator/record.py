"""An expert drives and is recorded, faster than real time."""

import functools
import multiprocessing
import os
import signal
import threading
from collections import deque
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from datetime import timedelta

from tqdm import tqdm

from cloning.errors import SimulatorError
from cloning.recordings.writer import EPOCH, Clock, RecordingWriter
from cloning.road.motion import MPH
from cloning.road.track import Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.expert import Expert, Recovery
from simulator.run import Run
from simulator.world import Scene

DRAWERS = min(3, os.cpu_count() or 1)  # processes that draw; the engine uses one core, and 50 MB of its own, in each


def _begin_drawing() -> None:
    """In a drawing process: leave Ctrl-C to the recorder, and end when it does, even if it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end():
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


@functools.cache
def _cameras(track: str, look: int) -> Cameras:
    return Cameras(Scene(scenery.build(track, look)))


def _draw(track: str, look: int, transform) -> list[bytes]:
    """In a drawing process: the three cameras' JPEGs. They depend on the car's place alone, not on rows before."""
    return [jpeg(frame) for frame in _cameras(track, look).frames(transform)]


def record(
    folder: str,
    track: Track,
    laps: float,
    speed: float = 30.0,
    seed: int = 0,
    look: int = 0,
    recovery: bool = False,
) -> Run:
    """Record the expert's laps at a set speed in mph into a new folder. Raises SimulatorError.

    recovery: only its returns from the road's sides. The images' names tell the seed's day, not today: the same seed
    and arguments make the same files.
    """
    run = Run(track)
    run.car.speed_limit = speed * MPH
    expert = (Recovery if recovery else Expert)(track, seed, speed * MPH)
    clock = Clock()
    with (
        RecordingWriter(folder, EPOCH + timedelta(days=seed % 10_000)) as recording,
        ProcessPoolExecutor(DRAWERS, initializer=_begin_drawing) as drawers,
        tqdm(total=round(laps * track.length), unit="m", unit_scale=True, disable=None) as bar,
    ):
        rows = deque()  # that are being drawn

        def write():
            time, images, *numbers = rows.popleft()
            recording.add(time, images.result(), *numbers)

        try:
            while run.travelled < laps * track.length:
                run.step(*expert.drive(run))
                if clock.due(run.time) and (not recovery or expert.recording):
                    images = drawers.submit(_draw, track.name, look, run.car.node.get_transform())
                    rows.append(
                        (run.time, images, run.steering, max(0.0, run.throttle), max(0.0, -run.throttle), run.speed_mph)
                    )
                    if len(rows) > 2 * DRAWERS:
                        write()
                    bar.update(round(max(0.0, run.travelled)) - bar.n)
            while rows:
                write()
        except BrokenExecutor as error:
            raise SimulatorError(
                f"{folder}: a process that draws was killed (out of memory?); the {recording.rows} "
                "rows before are whole"
            ) from error
    return run
