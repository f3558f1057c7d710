"""Measure the speed and the memory use of the stand-in simulator.

    python -m tools.bench_simulator                 # three laps of each track
    python -m tools.bench_simulator --laps 0.3      # faster, but less accurate

Recording: `python -m simulator record` in a process of its own: three cameras, JPEG and csv. Lock-step: the time that
the simulator itself needs for a frame, without the server and the transfer. "cpu" is the processor time of all cores;
other load on the machine disturbs it less than wall time. Memory is that of all recording processes, with shared pages
counted once. Needs Linux, because memory is read from /proc.
"""

import contextlib
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import SimulatorError
from cloning.recordings.format import DRIVING_LOG, SAMPLE_RATE
from cloning.road.track import ROADS, Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.car import STEP
from simulator.expert import Expert
from simulator.run import Run
from simulator.world import Scene
from tools.command import ROOT

WARM_UP = 20  # frames before the lock-step measurement


def memory(pid: int) -> float:
    """Return the memory that a process and its children use, in MB."""
    total = 0
    for process in (str(pid), *Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="utf-8").split()):
        text = Path(f"/proc/{process}/smaps_rollup").read_text(encoding="utf-8")
        total += sum(int(kilobytes) for kilobytes in re.findall(r"^Pss: +(\d+)", text, re.MULTILINE))
    return total / 1024


def recording(track: str, laps: float) -> tuple[float, float, float]:
    """Record laps in a process of its own. Raises SimulatorError.

    Returns the simulated seconds per second of wall time and of processor time, and the peak memory use in MB.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "simulator", "record", f"{folder}/out", "--track", track, "--laps", str(laps)]
        begin = time.perf_counter()
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        peak = 0.0
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # a child that has just ended
                peak = max(peak, memory(process.pid))
            time.sleep(0.2)
        _, status, usage = ended
        wall = time.perf_counter() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SimulatorError(
                f"{' '.join(command)}: exit status {process.returncode}; run it alone to see its message"
            )
        rows = (Path(folder) / "out" / DRIVING_LOG).read_text(encoding="utf-8").count("\n")
    simulated = rows / SAMPLE_RATE
    return simulated / wall, simulated / (usage.ru_utime + usage.ru_stime), peak


def lockstep(track: str, frames: int) -> tuple[float, float]:
    """Return the milliseconds of wall time and of processor time for a frame: physics, one camera, JPEG."""
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


def measure(laps: float, repeat: int, frames: int) -> None:
    """Measure both tracks and print the table. Raises SimulatorError."""
    import resource  # missing on Windows, where main refuses to run

    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start")
    print("track   recording, times real time     memory   lock-step, ms per frame")
    print("        wall (worst)  cpu (worst)      MB       wall   cpu")
    for track in ROADS:
        wall, cpu, memory = zip(*(recording(track, laps) for _ in range(repeat)), strict=True)
        frame_wall, frame_cpu = lockstep(track, frames)
        print(
            f"{track:7} {statistics.median(wall):.1f} ({min(wall):.1f})     {statistics.median(cpu):.1f} "
            f"({min(cpu):.1f})        {max(memory):.0f}      {frame_wall:.1f}   {frame_cpu:.1f}"
        )
    print(f"peak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def main(argv: list[str] | None = None) -> int:
    """Parse the command line, measure and return the exit status. Raises SimulatorError."""
    parser = command_line("python -m tools.bench_simulator", __doc__)
    add = parser.add_argument
    add("--laps", type=number(float, 0.001, 1e5), default=1, help="to record on each track (default %(default)s)")
    add("--repeat", type=number(int, 1), default=3, help="recordings of each track (default %(default)s)")
    add("--frames", type=number(int, 1), default=300, help="in lock-step on each track (default %(default)s)")
    options = parser.parse_args(argv)
    if not Path("/proc/self/smaps_rollup").exists():
        parser.error("needs Linux, because memory is read from /proc")
    measure(options.laps, options.repeat, options.frames)
    return program.DONE


if __name__ == "__main__":
    program.run(main)
