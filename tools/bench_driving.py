"""How fast drive.py answers, beside the floor and beside the usual shape of such a server, in one run.

    python -m tools.bench_driving model.pt data/lake-ccw                     # a minute or two
    python -m tools.bench_driving model.pt data/lake-ccw --frames 50000      # whether memory stays flat

One client in lock-step over loopback, in the simulator's fragments and without TCP_NODELAY. The floor is what can't be
saved: decoding that JPEG and a bare forward pass, batch 1, one thread. The servers take turns, so that what else the
machine does falls on all alike.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import torch

from cloning.pilot.network import load_model
from cloning.recordings.images import decode
from tools.simulator_client import Simulator, fragments, telemetry

ROOT = Path(__file__).parent.parent

TICKS = 100  # a second, in /proc/PID/stat


class Server:
    """A server process and a client in lock-step with it."""

    def __init__(self, name: str, command: list):
        self.name = name
        self.process = subprocess.Popen([sys.executable, *map(str, command)], stderr=subprocess.PIPE, text=True)
        lines = (re.search(r"Listening on .*:(\d+)", line) for line in self.process.stderr)
        self.port = next(int(found[1]) for found in lines if found)
        threading.Thread(target=self.process.stderr.read, daemon=True).start()
        self.client = Simulator(self.port)
        self.client.open()
        self.round_trips, self.inside, self.memory = [], [], []
        self.seconds = self.cpu = 0.0

    def close(self):
        self.client.socket.close()
        self.process.terminate()
        self.process.wait()

    def drive(self, messages: list[list[bytes]], count: bool = True) -> None:
        self.client.send("2")  # as the simulator does every 25 s, or the classic server hangs up
        self.client.receive()
        cpu, began = self.cpu_seconds(), time.perf_counter()
        for fragments_of_one in messages:
            start = time.perf_counter()
            for fragment in fragments_of_one:
                self.client.socket.sendall(fragment)
            self.client.receive()
            if count:
                self.round_trips.append(time.perf_counter() - start)
        if count:
            self.seconds += time.perf_counter() - began
            self.cpu += self.cpu_seconds() - cpu
            status = Path(f"/proc/{self.process.pid}/status").read_text()
            self.memory.append(int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024)

    def cpu_seconds(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    def ask_inside(self, frames: int) -> None:
        """The server's own times of the last frames, from the page's events."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/live", timeout=10) as events:
            rows = json.loads(next(line for line in events if line.startswith(b"data:"))[6:])["rows"]
        self.inside += [row[-1] / 1000 for row in rows[-frames:]]


@contextmanager
def page_open(port: int):
    """A reader of the page's events, with the attention, as a browser would be."""
    reader = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import sys, urllib.request\nfor line in urllib.request.urlopen(sys.argv[1]): pass",
            f"http://127.0.0.1:{port}/live?attention",
        ]
    )
    time.sleep(1)
    yield
    reader.kill()
    reader.wait()


def floor(network, jpegs: list[bytes]) -> list[float]:
    times = []
    for jpeg in jpegs:
        start = time.perf_counter()
        with torch.inference_mode():
            float(network(torch.from_numpy(decode(jpeg))[None])[0])
        times.append(time.perf_counter() - start)
    return times


def milliseconds(times) -> str:
    return f"{np.median(times) * 1e3:7.2f} {np.quantile(times, 0.99) * 1e3:8.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("recording", type=Path, help="its centre images are sent")
    parser.add_argument("--frames", type=int, default=3000, help="to each server (default %(default)s)")
    args = parser.parse_args()
    jpegs = [path.read_bytes() for path in sorted(args.recording.glob("IMG/center_*.jpg"))[:500]]
    messages = [fragments("42" + json.dumps(["telemetry", telemetry(jpeg, speed="9.0000")])) for jpeg in jpegs]
    torch.set_num_threads(1)
    network, floors, per_turn = load_model(args.model), [], 100
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        drive = [ROOT / "drive.py", args.model]
        servers = [
            Server("drive.py", [*drive, "--port", 0]),
            Server("drive.py, saving frames", [*drive, Path(folder) / "run1", "--port", 0]),
            Server("drive.py, page open", [*drive, "--port", 0]),
            Server("classic", ["-m", "tools.classic_server", args.model]),
        ]
        for server in servers:
            stack.callback(server.close)
            server.drive(messages[:50], count=False)
        at = 0
        for _ in range(args.frames // per_turn):
            part, at = slice(at, at + per_turn), (at + per_turn) % len(jpegs)
            floors += floor(network, jpegs[part])
            for server in servers:
                if "page" in server.name:
                    with page_open(server.port):
                        server.drive(messages[part])
                else:
                    server.drive(messages[part])
                if "drive" in server.name:
                    server.ask_inside(per_turn)
    best = np.median(floors)
    print(
        f"{len(floors)} frames each; times in ms\n{'':25} median      p99  /floor  frames/s  CPU/frame  MB first  last"
    )
    print(f"{'floor: decode + forward':24} {milliseconds(floors)}    1.00")
    for server in servers:
        print(
            f"{server.name:24} {milliseconds(server.round_trips)} {np.median(server.round_trips) / best:7.2f} "
            f"{len(server.round_trips) / server.seconds:9.1f} {server.cpu / len(server.round_trips) * 1e3:10.2f} "
            f"{server.memory[0]:9.0f} {server.memory[-1]:5.0f}"
        )
        if server.inside:
            print(f"{'  in the server':24} {milliseconds(server.inside)} {np.median(server.inside) / best:7.2f}")


if __name__ == "__main__":
    main()
