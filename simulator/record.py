"""Record laps that the expert drives, faster than real time."""

import functools
from collections import deque
from concurrent.futures import BrokenExecutor, Future
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from panda3d.core import TransformState

from cloning.base.cores import threads
from cloning.base.errors import SimulatorError
from cloning.base.progress import progress_bar
from cloning.recordings.writer import RecordingWriter, SampleClock, start_of
from cloning.road.disturbances import Disturbance
from cloning.road.generated import PointRoad
from cloning.road.motion import MPH, TOP_SPEED_MPH
from cloning.road.track import Track
from simulator.cameras import Cameras, jpeg
from simulator.expert import Expert, Recovery
from simulator.run import Run
from simulator.workers import started_workers
from simulator.world import Scene

MAX_RENDERERS = 3  # processes; each uses one core and 50 MB


_View = tuple[str | PointRoad, int, Disturbance | None, int]  # road, look, disturbance and its seed


@functools.cache
def _cameras(view: _View) -> Cameras:
    source, look, disturbance, seed = view
    return Cameras(Scene.of(source, look), disturbance=disturbance, seed=seed)


def _render(view: _View, transform: TransformState, begins: bool) -> list[bytes]:
    """Return the three cameras' JPEGs, perhaps the first of a drive; runs in a rendering process."""
    cameras = _cameras(view)
    if begins:
        cameras.disturb(*view[2:])
    return [jpeg(frame) for frame in cameras.frames(transform)]


def sample(run: Run) -> dict[str, Any]:
    """Return what a recording keeps of the run's present state besides the images, as RecordingWriter.add takes it."""
    numbers = (run.steering, max(0.0, run.throttle), max(0.0, -run.throttle), run.speed_mph)
    return {"time": run.time, "numbers": numbers, "lane": run.lane}


def write_row(recording: RecordingWriter, cameras: Cameras, run: Run) -> None:
    """Render the three cameras, and add a row of the run's present state to a recording. Raises RecordingError."""
    frames = cameras.frames(run.car.node.get_transform())
    recording.add(images=[jpeg(frame) for frame in frames], **sample(run))


def record(
    folder: str | Path,
    track: Track,
    laps: float,
    speed: float = TOP_SPEED_MPH,
    seed: int = 0,
    look: int = 0,
    recovery: bool = False,
    disturbance: Disturbance | None = None,
) -> tuple[Run, int]:
    """Record the expert's laps into a new folder; return the run and the number of rows. Call it in the main thread.

    speed: set speed in mph; recovery: record only returns from the road's edges; disturbance: of all images. The dates
    in the images' names depend on the other arguments, not on today's date, so that the same give the same files.
    Raises RecordingError if the folder can't be written or holds a recording, SimulatorError if a rendering process is
    killed.
    """
    run = Run(track)
    run.car.speed_limit = speed * MPH
    expert = (Recovery if recovery else Expert)(track, seed, speed * MPH)
    clock = SampleClock()
    view = (track.source, look, disturbance, seed)
    what = (track.name, round(track.length), track.direction, laps, speed, look, recovery, disturbance)
    # A disturbed frame depends on those before it; without a disturbance it depends on the car's pose alone.
    renderers = 1 if disturbance else min(MAX_RENDERERS, threads())
    pending: deque[tuple[Future[list[bytes]], dict[str, Any]]] = deque()  # images being rendered, and their samples
    with ExitStack() as stack:
        recording = stack.enter_context(RecordingWriter(folder, start_of(seed, *what)))
        pool = stack.enter_context(started_workers(renderers))
        bar = stack.enter_context(progress_bar(round(laps * track.length), "m"))
        begins = True  # whether the next row is the first of a drive, before which no frame was seen

        def write() -> None:
            images, row = pending.popleft()
            recording.add(images=images.result(), **row)

        try:
            while run.travelled < laps * track.length:
                if run.at_end:
                    while pending:
                        write()
                    recording.begin_drive()
                    begins = True
                run.step(*expert.drive(run))
                due = clock.due(run.time)
                begins = begins or (due and not expert.recordable)
                if due and expert.recordable:
                    images, begins = pool.submit(_render, view, run.car.node.get_transform(), begins), False
                    pending.append((images, sample(run)))
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
