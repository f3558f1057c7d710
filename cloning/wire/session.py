"""A conversation with drive.py, one frame under way at a time: what driving and replaying have in common."""

import sys
import time

from cloning.errors import SimulatorError
from cloning.wire.client import RETRY, Answer, Connection, Gone, read

OPENS = 2  # telemetry is sent twice at the start, since the real client's "open" fires twice
GREETING = 1.0  # s for a server to give its first command


class ClientSession:
    """Sends telemetry and takes the answers, connecting again when the server goes away."""

    def __init__(self, host: str, port: int, wait: float, patient: bool = False):
        """wait: seconds of patience with a server that is not there or does not answer usably.

        patient: see Connection.
        """
        self.address, self.wait, self.patient = (host, port), wait, patient
        self.round_trips: list[float] = []  # s
        self.dropped = self.reconnections = 0
        self.wire: Connection | None = None
        self.tokens = 1  # frames under way

    def connect(self) -> Connection:
        """Try until the server is there and has opened a session. Raises SimulatorError when patience is
        at its end."""
        until, said = time.monotonic() + self.wait, False
        while True:
            try:
                return Connection(*self.address, patient=self.patient)
            except Gone as error:
                if time.monotonic() > until:
                    raise SimulatorError(f"{error}; is `python drive.py model.pt` running?") from None
                if not said:
                    print(f"{error}; trying again for {self.wait:.0f} s", file=sys.stderr)
                    said = True
                time.sleep(RETRY)

    def usable(self, packet: str) -> Answer | None:
        answer = read(packet)
        if answer is None and packet.startswith("4") and packet != "40":
            self.dropped += 1
        return answer

    def listen(self) -> None:
        """Hear what the server says of its own accord at the start.

        The first frame is sent three times, as by the real client: for its two opens, and in answer to the command
        that the server gives on its own.
        """
        self.tokens = OPENS
        while (packet := self.wire.receive(GREETING)) is not None:
            if self.usable(packet):
                self.tokens += 1
            if packet.startswith("40"):
                break

    def early(self) -> Answer:
        """What came of itself since the last answer, so that it is never mistaken for the next frame's."""
        latest = Answer()
        while (packet := self.wire.receive(0)) is not None:
            latest = self.usable(packet) or latest
        return latest

    def exchange(self, packet: str) -> Answer:
        """The answer to a telemetry packet. Raises SimulatorError when patience is at its end, Gone with the
        connection."""
        sent = time.perf_counter()
        for _ in range(self.tokens):
            self.wire.send(packet)
        for _ in range(self.tokens):
            answer = self._await()
            self.round_trips.append(time.perf_counter() - sent)
        self.tokens = 1
        return answer

    def _await(self) -> Answer:
        until = time.monotonic() + self.wait
        while True:
            packet = self.wire.receive(max(0.0, until - time.monotonic()))
            if packet is None:
                raise SimulatorError(
                    f"no usable answer in {self.wait:.0f} s ({self.dropped} unusable ones so far); "
                    "steer must carry strings, see drive.py"
                )
            answer = self.usable(packet)
            if answer:
                return answer

    def reconnect(self, error: Gone) -> None:
        self.reconnections += 1
        print(f"{error}; connecting again", file=sys.stderr)

    def close(self) -> None:
        if self.wire:
            self.wire.close()
            self.wire = None
