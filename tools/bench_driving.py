"""Measure how fast drive.py answers, compared with the lower bound and with a typical server.

    python -m tools.bench_driving model.pt data/lake-ccw                     # one or two minutes
    python -m tools.bench_driving model.pt data/lake-ccw --frames 50000      # shows whether memory use grows

Each server has a client that sends telemetry over loopback, in the simulator's fragments and without TCP_NODELAY, and
waits for each answer. The lower bound is the time to decode the JPEG and run one forward pass (batch size 1, one
thread). The servers take turns, so that other load on the machine affects all of them equally. Needs Linux, because CPU
time and memory are read from /proc.
"""

import itertools
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

import numpy as np
import torch

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.network.network import Network, load_model
from cloning.recordings.images import decode
from cloning.wire.client import telemetry_packet
from tools.command import ROOT, ServerProcess
from tools.simulator_client import Simulator, fragments

TURN = 100  # frames that a server answers in one turn
WARM_UP = 50  # frames that are not counted
PAGE_OPEN = "drive.py, page open"  # its name in the table


class Server(ServerProcess):
    """A server process with a connected client, and its measurements; name: in the table."""

    def __init__(self, name: str, *command: object):
        super().__init__(*command)
        self.name = name
        self.client = Simulator(self.port)
        self.client.open()
        self.round_trips: list[float] = []  # seconds
        self.megabytes: list[float] = []  # resident, after each turn
        self.seconds = self.cpu_time = 0.0  # over all counted frames

    def __exit__(self, *_: object) -> None:
        self.client.socket.close()
        super().__exit__()

    def drive(self, messages: list[list[bytes]], count: bool = True) -> None:
        """Send messages, each a list of fragments, one after each answer; measure them if `count`."""
        cpu_before, started = self.cpu_seconds(), time.perf_counter()
        for message in messages:
            sent = time.perf_counter()
            for fragment in message:
                self.client.socket.sendall(fragment)
            while self.client.receive() == "2":  # a ping: without an answer, the typical server closes after 20 s
                self.client.send("3")
            if count:
                self.round_trips.append(time.perf_counter() - sent)
        if count:
            self.seconds += time.perf_counter() - started
            self.cpu_time += self.cpu_seconds() - cpu_before
            self.megabytes.append(self.memory())


@contextmanager
def open_page(port: int) -> Iterator[None]:
    """Read the page's events with attention maps in another process, as a browser with the open page does."""
    read_events = "import sys, urllib.request\nfor line in urllib.request.urlopen(sys.argv[1]): pass"
    address = f"http://127.0.0.1:{port}/live?attention"
    command = [sys.executable, "-c", read_events, address]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as reader:  # Ctrl-C ends it, too, with a traceback
        try:
            time.sleep(1)
            yield
        finally:
            reader.kill()


def lower_bounds(network: Network, jpegs: list[bytes]) -> list[float]:
    """Return the seconds to decode each JPEG and run one forward pass on it."""
    times = []
    for jpeg in jpegs:
        started = time.perf_counter()
        with torch.inference_mode():
            float(network(torch.from_numpy(decode(jpeg))[None])[0])
        times.append(time.perf_counter() - started)
    return times


def milliseconds(times: list[float], bound: list[float]) -> str:
    """Format the median and the 99th percentile of times in seconds, and the median's ratio to that of the bound."""
    median = np.median(times)
    return f"{median * 1e3:7.2f} {np.quantile(times, 0.99) * 1e3:8.2f} {median / np.median(bound):7.2f}"


def measure(model: str, jpegs: list[bytes], frames: int) -> tuple[list[float], list[Server]]:
    """Return the lower bounds in seconds, and the servers with their measurements. Raises UserError."""
    messages = [fragments(telemetry_packet(0, 0, 9, jpeg)) for jpeg in jpegs]
    network, bounds = load_model(model), []
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        drive = (ROOT / "drive.py", model, "--port", 0)
        commands: dict[str, tuple[object, ...]] = {
            "drive.py": drive,
            "drive.py, saving frames": (*drive, Path(folder) / "run1"),
            PAGE_OPEN: drive,
            "typical server": ("-c", "from tools.classic_server import main; main()", model),
        }
        servers = [stack.enter_context(Server(name, *command)) for name, command in commands.items()]
        for server in servers:
            server.drive(messages[:WARM_UP], count=False)
        turns = itertools.cycle(range(0, len(jpegs), TURN))
        for start in itertools.islice(turns, frames // TURN):
            turn = slice(start, start + TURN)
            bounds += lower_bounds(network, jpegs[turn])
            for server in servers:
                with open_page(server.port) if server.name == PAGE_OPEN else nullcontext():
                    server.drive(messages[turn])
    return bounds, servers


def main(argv: list[str] | None = None) -> int:
    """Run the benchmark and print its table; return the exit status. Raises UserError."""
    parser = command_line("python -m tools.bench_driving", __doc__)
    add = parser.add_argument
    add("model", help="a model file of model.py")
    add("recording", type=Path, help="folder of a recording, whose first 500 centre images are sent")
    add("--frames", type=number(int, TURN), default=3000, help="frames for each server (default %(default)s)")
    options = parser.parse_args(argv)
    if not Path("/proc/self/stat").exists():
        parser.error("needs Linux, because CPU time and memory are read from /proc")
    jpegs = [path.read_bytes() for path in sorted(options.recording.glob("IMG/center_*.jpg"))[:500]]
    if not jpegs:
        parser.error(f"{options.recording}: no centre images in its IMG/; name a folder that holds driving_log.csv")
    torch.set_num_threads(1)
    bounds, servers = measure(options.model, jpegs, options.frames)
    print(f"{len(bounds)} frames each; times in ms")
    print(f"{'':25} median      p99  /bound  frames/s  CPU/frame  MB first  last")
    print(f"{'bound: decode + forward':24} {milliseconds(bounds, bounds)}")
    for server in servers:
        count = len(server.round_trips)
        print(
            f"{server.name:24} {milliseconds(server.round_trips, bounds)} {count / server.seconds:9.1f} "
            f"{server.cpu_time / count * 1e3:10.2f} {server.megabytes[0]:9.0f} {server.megabytes[-1]:5.0f}"
        )
    return program.DONE


if __name__ == "__main__":
    program.run(main)
