"""How fast the stand-in simulator is, and how much memory it takes (on Linux).

    python -m tools.bench_simulator                 # both tracks, a table
    python -m tools.bench_simulator --laps 0.3      # sooner

Recording: three cameras, JPEG and csv, as `python -m simulator record` does it, in a process of its own. Lock-step:
what the simulator itself adds to a frame, without the server's time and the wire's. "cpu" figures count the processor
time of all cores, which other load on the machine disturbs less than wall time. Memory is that of all processes that
record, with shared pages counted once.
"""

import argparse
import contextlib
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from cloning.errors import SimulatorError, UserError
from cloning.recordings.format import DRIVING_LOG, SAMPLE_RATE
from cloning.road.track import ROADS, Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.car import STEP
from simulator.expert import Expert
from simulator.run import Run
from simulator.world import Scene

ROOT = Path(__file__).resolve().parent.parent
WARM_UP = 20  # frames before the lock-step measurement


@dataclass(frozen=True)
class Speed:
    """Simulated seconds per second of wall time and of processor time, and the peak memory in MB."""

    wall: float
    cpu: float
    memory: float


def memory(pid: int) -> float:
    """Return the MB that a process and its children hold in memory."""
    total = 0
    for process in (str(pid), *Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()):
        text = Path(f"/proc/{process}/smaps_rollup").read_text(encoding="utf-8")
        total += sum(int(kilobytes) for kilobytes in re.findall(r"^Pss: +(\d+)", text, re.MULTILINE))
    return total / 1024


def recording(track: str, laps: float) -> Speed:
    """Record in a process of its own and measure it. Raises SimulatorError."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "simulator", "record", f"{folder}/out", "--track", track, "--laps", str(laps)]
        begin = time.perf_counter()
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
        peak = 0.0
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a child that has just ended
                peak = max(peak, memory(process.pid))
            time.sleep(0.2)
        _, status, usage = ended
        wall = time.perf_counter() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SimulatorError(f"{' '.join(command)} ended with {process.returncode}: run it to see its message")
        rows = (Path(folder) / "out" / DRIVING_LOG).read_text(encoding="utf-8").count("\n")
    simulated = rows / SAMPLE_RATE
    return Speed(simulated / wall, simulated / (usage.ru_utime + usage.ru_stime), peak)


def lockstep(track: str, frames: int) -> tuple[float, float]:
    """Return the milliseconds of wall and of processor time for a frame: physics, one camera, JPEG."""
    run = Run(Track(track), "autonomous")
    cameras, expert = Cameras(Scene(scenery.build(track)), ("center",)), Expert(run.track)

    def drive(first: int, last: int) -> None:
        for i in range(first, last):
            while run.time < (i + 1) / SAMPLE_RATE - STEP / 2:
                run.step(*expert.drive(run))
            jpeg(cameras.frames(run.car.node.get_transform())[0])

    drive(0, WARM_UP)
    wall, cpu = time.perf_counter(), time.process_time()
    drive(WARM_UP, WARM_UP + frames)
    return (time.perf_counter() - wall) / frames * 1000, (time.process_time() - cpu) / frames * 1000


def measure(laps: float, repeat: int) -> None:
    """Measure both tracks and print the table."""
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start")
    print("track   recording, times real time     memory   lock-step, ms a frame")
    print("        wall (worst)  cpu (worst)      MB       wall   cpu")
    for track in ROADS:
        runs = [recording(track, laps) for _ in range(repeat)]
        wall, cpu = [run.wall for run in runs], [run.cpu for run in runs]
        frame_wall, frame_cpu = lockstep(track, 300)
        print(
            f"{track:7} {statistics.median(wall):.1f} ({min(wall):.1f})     "
            f"{statistics.median(cpu):.1f} ({min(cpu):.1f})        "
            f"{max(run.memory for run in runs):.0f}      {frame_wall:.1f}   {frame_cpu:.1f}"
        )
    print(f"memory of this process at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def main() -> int:
    """Parse the command line, measure and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laps", type=float, default=1.0, help="laps to record on each track (default 1)")
    parser.add_argument("--repeat", type=int, default=3, help="recordings of each track (default 3)")
    args = parser.parse_args()
    try:
        measure(args.laps, args.repeat)
    except UserError as error:
        print(f"bench_simulator: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
