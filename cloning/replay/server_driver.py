"""The driver of a replay that is a running drive.py."""

from cloning.replay.replay import ReplayFrame
from cloning.wire.client import ConnectionLost, Driven, telemetry_packet
from cloning.wire.session import ClientSession


class ServerDriver(Driven, ClientSession):
    """Sends drive.py the telemetry that the simulator would send, and returns the steering of its answers."""

    def __call__(self, frame: ReplayFrame) -> float:
        """Return the steering, -1..1. Raises SimulatorError if the server is missing, or silent, for too long."""
        packet = telemetry_packet(self.steering, self.throttle, frame.speed, frame.jpeg(), time=frame.time)
        while True:
            try:
                if not self.connected:
                    self.connect()
                    self.receive_greeting()
                self.receive_unasked()
                self.apply(self.request_answer(packet))
                return self.steering
            except ConnectionLost as error:
                self.count_reconnection(error)
                self.close()
