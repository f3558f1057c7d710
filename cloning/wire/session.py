"""A session with drive.py that has one telemetry in flight at a time, for driving and for replaying."""

import sys
import time

from cloning.base import program
from cloning.base.errors import SimulatorError, printable
from cloning.base.progress import Bar
from cloning.wire.client import (
    CONNECT,
    CONNECT_TIMEOUT,
    EVENT,
    GREETING_TIMEOUT,
    MAX_PACKET,
    MESSAGE,
    SEND_TIMEOUT,
    USABLE,
    Answer,
    Connection,
    ConnectionLost,
    NoServer,
    parse_answer,
)
from cloning.wire.protocol import where_options

OPENS = 2  # telemetries sent at the start: the real client's "open" event fires twice
RETRY_INTERVAL = 0.1  # s between two attempts to connect; the real client makes thousands a second
MAX_UNASKED = 100  # commands that came unasked and are read before a frame; a server could send them without end


class ClientSession:
    """Sends telemetry and receives the answers, and connects again when the connection is lost.

    Connecting is no progress, since a server may break each connection: only an answer that the car was driven by
    (`request_answer` returned it, or `progressed` was called) lets `wait` seconds begin anew.
    """

    remedy = "; start `python drive.py{}` in another terminal"  # where there is no server; {}: its host and port
    connect_timeout = CONNECT_TIMEOUT

    def __init__(self, host: str, port: int, wait: float, real_timing: bool = False, max_packet: int = MAX_PACKET):
        """wait: seconds to wait for a server to appear, or for a usable answer; the others: see Connection."""
        self.address, self.wait, self.real_timing, self.max_packet = (host, port), wait, real_timing, max_packet
        self.round_trips: list[float] = []  # s
        self.unusable = self.reconnections = 0
        self._connection: Connection | None = None
        self._in_flight = 1  # telemetries sent before the next answer is due
        self._waiting_until: float | None = None  # time.monotonic() at which patience ends; None: not waiting
        self._lost: ConnectionLost | None = None  # why the last connection broke, while waiting
        self._told = False  # whether the user knows that the server is not one for the real simulator
        self._shown = False  # whether the user has seen a command that cannot be used

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
        while self._connection is None:
            left = max(RETRY_INTERVAL, self._patience_ends() - time.monotonic())
            try:
                self._connection = Connection(
                    *self.address,
                    self.real_timing,
                    min(self.connect_timeout, left),
                    min(SEND_TIMEOUT, self.wait),
                    self.max_packet,
                )
            except ConnectionLost as error:
                self._wait_after(error)
            else:
                if self._connection.asked and not self._told:
                    self._told = True
                    unlike = "the real simulator would get no answer (python-socketio 4.6.1 gives it one)"
                    _print(f"this server waited to be asked for a connection: {unlike}")

    def _patience_ends(self) -> float:
        """Return the time.monotonic() at which patience ends; it begins when the first thing is waited for."""
        if self._waiting_until is None:
            self._waiting_until = time.monotonic() + self.wait
        return self._waiting_until

    def first_answer_due(self) -> float:
        """Return the time.monotonic() at which patience ends, or a moment later for a server that came at the end."""
        return max(self._patience_ends(), time.monotonic() + min(GREETING_TIMEOUT, self.wait))

    def _wait_after(self, error: ConnectionLost) -> None:
        """Wait before the next attempt, and say so once. Raises SimulatorError after `wait` seconds of attempts."""
        first, self._lost = self._lost is None, error
        if time.monotonic() > self._patience_ends():
            raise self.no_answer() from None
        if first:
            _print(f"{error}{self._remedy_for(error)}; trying again for {self.wait:g} s")
        time.sleep(RETRY_INTERVAL)

    def _remedy_for(self, error: ConnectionLost | None) -> str:
        return self.remedy.format(where_options(*self.address)) if isinstance(error, NoServer) else ""

    def progressed(self) -> None:
        """Begin `wait` anew, because an answer has driven the car."""
        self._waiting_until = self._lost = None

    def parse(self, packet: str) -> Answer | None:
        """Return the answer in a packet, or None; count messages that hold none, and show the first such command."""
        answer = parse_answer(packet)
        if answer is None and packet.startswith(MESSAGE) and not packet.startswith(CONNECT):
            self.unusable += 1
            if not self._shown and packet.startswith(f'{EVENT}["steer"'):
                self._shown = True
                _print(f"an answer cannot be used: {printable(packet[len(EVENT) :][:100])}; it must have {USABLE}")
        return answer

    def receive_greeting(self) -> None:
        """Receive the messages that the server sends unasked at the start: its first command and CONNECT.

        The real client sends the first frame three times: for each of its two "open" events, and in answer to the
        first command, if the server sends one.
        """
        self._in_flight = OPENS
        until = time.monotonic() + min(GREETING_TIMEOUT, self.wait)
        while (packet := self.connection.receive(max(0.0, until - time.monotonic()))) is not None:
            if self.parse(packet):
                self._in_flight = OPENS + 1
            if packet.startswith(CONNECT) or time.monotonic() > until:
                break

    def receive_unasked(self) -> Answer:
        """Return the last command that came unasked, which answers no later telemetry, or an empty answer."""
        latest = Answer()
        for _ in range(MAX_UNASKED):
            if (packet := self.connection.receive(0)) is None:
                break
            latest = self.parse(packet) or latest
        return latest

    def request_answer(self, packet: str) -> Answer:
        """Send a telemetry packet; return its answer. Raises SimulatorError after `wait` s without, ConnectionLost."""
        sent, until = time.perf_counter(), self.first_answer_due()
        for _ in range(self._in_flight):
            self.connection.send(packet)
        for _ in range(self._in_flight):
            answer = self._receive_answer(until)
            self.round_trips.append(time.perf_counter() - sent)
            until = time.monotonic() + self.wait
        self._in_flight = 1
        self.progressed()
        return answer

    def _receive_answer(self, until: float) -> Answer:
        while (packet := self.connection.receive(max(0.0, until - time.monotonic()))) is not None:
            if answer := self.parse(packet):
                return answer
            if time.monotonic() > until:
                break
        raise self.no_answer()

    def no_answer(self) -> SimulatorError:
        """Return the error for a server that is missing, breaks each connection, or sends nothing usable."""
        reason = f"{self._lost}; " if self._lost else ""
        remedy = self._remedy_for(self._lost)
        if self._connection:
            remedy = "; a server is there, but is silent: it is busy, or its handler of `telemetry` fails or is missing"
            remedy += ": see its output"
        if self.unusable:
            remedy = f"; {self.unusable} unusable answers so far: `steer` must have {USABLE}"
        return SimulatorError(f"{reason}no usable answer in {self.wait:g} s{remedy}")

    def count_reconnection(self, error: ConnectionLost) -> None:
        """Count a lost connection and wait before a new one is made. Raises SimulatorError after `wait` seconds."""
        self.reconnections += 1
        self._wait_after(error)

    def close(self) -> None:
        """Close the connection, if one is open."""
        if self._connection:
            self._connection.close()
            self._connection = None


def _print(message: str) -> None:
    """Print a message to stderr, above a progress bar if there is one."""
    Bar.write(program.in_commands(f"simulator: {message}"), file=sys.stderr)
