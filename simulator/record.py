"""An expert drives and is recorded, faster than real time."""

from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

from motion import MPH

from . import scenery
from .cameras import Cameras
from .expert import Expert, Recovery
from .progress import Progress
from .recording import EPOCH, Clock, Recording
from .run import Run
from .track import Track
from .world import Scene


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
    # A row is written while the next is drawn.
    with Recording(folder, EPOCH + timedelta(days=seed % 10_000)) as recording, ThreadPoolExecutor(1) as writer:
        run = Run(track)
        run.car.speed_limit = speed * MPH
        expert = (Recovery if recovery else Expert)(track, seed, speed * MPH)
        cameras = Cameras(Scene(scenery.build(track.name, look)))
        clock, progress = Clock(), Progress(laps, "laps")
        written = None
        while run.travelled < laps * track.length:
            steering, throttle = expert.drive(run)
            run.step(steering, throttle)
            if clock.due(run.time) and (not recovery or expert.recording):
                frames = cameras.frames(run.car.node.get_transform())
                if written:
                    written.result()
                written = writer.submit(recording.add, run.time, frames, run.steering, max(0.0, run.throttle),
                                        max(0.0, -run.throttle), run.speed_mph)
                progress.show(max(0.0, run.travelled) / track.length, run.time)
        if written:
            written.result()
        progress.finish(laps, run.time)
    return run
