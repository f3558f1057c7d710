"""How fast the stand-in simulator is, and how much memory it takes.

    python -m tools.bench_simulator                 # both tracks, a table
    python -m tools.bench_simulator --laps 0.3      # sooner

Recording: three cameras, JPEG and csv, as `python -m simulator record` does it, in a process of its own. Lock-step:
what the simulator itself adds to a frame, its server's time and the wire's left out. "cpu" figures count the processor
time of all cores, which other load on the machine disturbs less than wall time. Memory is that of all the processes
that record, what they share counted once (Linux tells it).
"""

import argparse
import contextlib
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cloning.road.track import Track
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.expert import Expert
from simulator.run import Run
from simulator.world import Scene

ROOT = Path(__file__).resolve().parent.parent


def memory(pid: int) -> float:
    """MB that a process and its children hold in memory."""
    total = 0
    for one in (str(pid), *Path(f"/proc/{pid}/task/{pid}/children").read_text().split()):
        text = Path(f"/proc/{one}/smaps_rollup").read_text()
        total += int(re.search(r"^Pss: +(\d+)", text, re.MULTILINE)[1])
    return total / 1024


def recording(track: str, laps: float) -> dict:
    """Record in a process of its own; seconds are simulated ones unless they say otherwise."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "simulator", "record", f"{folder}/out", "--track", track, "--laps", str(laps)]
        begin = time.perf_counter()
        process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
        most = 0.0
        while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
            with contextlib.suppress(FileNotFoundError, ProcessLookupError, TypeError):  # one that has just ended
                most = max(most, memory(process.pid))
            time.sleep(0.2)
        _, status, usage = ended
        wall = time.perf_counter() - begin
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{' '.join(command)} ended with {process.returncode}")
        rows = (Path(folder) / "out" / "driving_log.csv").read_text().count("\n")
    cpu = usage.ru_utime + usage.ru_stime
    simulated = rows / 15
    return {"rows": rows, "wall": simulated / wall, "cpu": simulated / cpu, "memory": most}


def lockstep(track: str, frames: int) -> tuple[float, float]:
    """Milliseconds of wall and of processor time that a frame takes: physics, one camera, JPEG."""
    run = Run(Track(track), "autonomous")
    cameras, expert = Cameras(Scene(scenery.build(track)), ("center",)), Expert(run.track)
    begin = None
    for i in range(frames + 20):
        if i == 20:
            begin = time.perf_counter(), time.process_time()
        for _ in range(3 + (i % 3 == 0)):  # 50 steps a second, 15 frames
            run.step(*expert.drive(run))
        jpeg(cameras.frames(run.car.node.get_transform())[0])
    return tuple(
        (now - then) / frames * 1000
        for now, then in zip((time.perf_counter(), time.process_time()), begin, strict=True)
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laps", type=float, default=1.0, help="to record of each track (default 1)")
    parser.add_argument("--repeat", type=int, default=3, help="recordings of each track (default 3)")
    args = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start")
    print("track   recording, times real time     memory   lock-step, ms a frame")
    print("        wall (worst)  cpu (worst)      MB       wall   cpu")
    for track in ("lake", "jungle"):
        runs = [recording(track, args.laps) for _ in range(args.repeat)]
        wall, cpu = ([run[key] for run in runs] for key in ("wall", "cpu"))
        step = lockstep(track, 300)
        print(
            f"{track:7} {sorted(wall)[len(wall) // 2]:.1f} ({min(wall):.1f})     "
            f"{sorted(cpu)[len(cpu) // 2]:.1f} ({min(cpu):.1f})        "
            f"{max(run['memory'] for run in runs):.0f}      {step[0]:.1f}   {step[1]:.1f}"
        )
    print(f"memory of this process at most {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
