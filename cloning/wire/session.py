"""A session with drive.py that has one telemetry in flight at a time, for driving and for replaying."""

import sys
import time

from tqdm import tqdm

from cloning.errors import SimulatorError
from cloning.wire.client import CONNECT, MESSAGE, Answer, Connection, ConnectionLost, parse_answer

OPENS = 2  # telemetries sent at the start: the real client's "open" event fires twice
GREETING_TIMEOUT = 1.0  # s for a server to send its first command
RETRY_INTERVAL = 0.1  # s between two attempts to connect; the real client makes thousands a second


class ClientSession:
    """Sends telemetry and receives the answers, and connects again when the connection is lost."""

    def __init__(self, host: str, port: int, wait: float, real_timing: bool = False):
        """wait: seconds to wait for a server to appear, or for a usable answer; real_timing: see Connection."""
        self.address, self.wait, self.real_timing = (host, port), wait, real_timing
        self.round_trips: list[float] = []  # s
        self.unusable = self.reconnections = 0
        self._connection: Connection | None = None
        self._in_flight = 1  # telemetries sent before the next answer is due

    @property
    def connected(self) -> bool:
        """Whether a connection is open."""
        return self._connection is not None

    @property
    def connection(self) -> Connection:
        """The open connection. Raises ConnectionLost if there is none."""
        if self._connection is None:
            raise ConnectionLost("not connected")
        return self._connection

    def connect(self) -> None:
        """Try to connect until the server has opened a session. Raises SimulatorError after `wait` seconds."""
        until, announced = time.monotonic() + self.wait, False
        while self._connection is None:
            try:
                self._connection = Connection(*self.address, real_timing=self.real_timing)
            except ConnectionLost as error:
                if time.monotonic() > until:
                    raise SimulatorError(f"{error}; start `python drive.py model.pt` first") from None
                if not announced:
                    _print(f"{error}; trying again for {self.wait:g} s")
                    announced = True
                time.sleep(RETRY_INTERVAL)

    def parse(self, packet: str) -> Answer | None:
        """Return the answer in a packet, or None; count messages that hold none."""
        answer = parse_answer(packet)
        if answer is None and packet.startswith(MESSAGE) and packet != CONNECT:
            self.unusable += 1
        return answer

    def receive_greeting(self) -> None:
        """Receive the messages that the server sends unasked at the start: its first command and CONNECT.

        The real client sends the first frame three times: for each of its two "open" events, and in answer to the
        first command, if the server sends one.
        """
        self._in_flight = OPENS
        while (packet := self.connection.receive(GREETING_TIMEOUT)) is not None:
            if self.parse(packet):
                self._in_flight += 1
            if packet.startswith(CONNECT):
                break

    def receive_unasked(self) -> Answer:
        """Return the last command that came unasked, or an empty answer if none did.

        If it were not taken now, it would pass for the answer to the next telemetry.
        """
        latest = Answer()
        while (packet := self.connection.receive(0)) is not None:
            latest = self.parse(packet) or latest
        return latest

    def request_answer(self, packet: str) -> Answer:
        """Send a telemetry packet and return its answer.

        Raises SimulatorError after `wait` seconds without one, ConnectionLost.
        """
        sent = time.perf_counter()
        for _ in range(self._in_flight):
            self.connection.send(packet)
        for _ in range(self._in_flight):
            answer = self._receive_answer()
            self.round_trips.append(time.perf_counter() - sent)
        self._in_flight = 1
        return answer

    def _receive_answer(self) -> Answer:
        until = time.monotonic() + self.wait
        while True:
            packet = self.connection.receive(max(0.0, until - time.monotonic()))
            if packet is None:
                raise self.no_answer()
            if answer := self.parse(packet):
                return answer

    def no_answer(self) -> SimulatorError:
        """Return the error for a server that sends nothing usable."""
        return SimulatorError(
            f"no usable answer in {self.wait:g} s ({self.unusable} unusable answers so far); "
            "`steer` must contain strings, as drive.py sends them"
        )

    def count_reconnection(self, error: ConnectionLost) -> None:
        """Count a lost connection and say that a new one will be made."""
        self.reconnections += 1
        _print(f"{error}; connecting again")

    def close(self) -> None:
        """Close the connection, if one is open."""
        if self._connection:
            self._connection.close()
            self._connection = None


def _print(message: str) -> None:
    """Print a message to stderr, above a progress bar if there is one."""
    tqdm.write(f"simulator: {message}", file=sys.stderr)
