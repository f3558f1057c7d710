"""The drivers of a replay: drive.py over the wire, or a model in this process."""

from typing import TYPE_CHECKING

from cloning.errors import SimulatorError
from cloning.recordings.format import FRAME
from cloning.replay.replay import ReplayFrame
from cloning.wire.client import ConnectionLost, telemetry_packet
from cloning.wire.session import ClientSession

if TYPE_CHECKING:
    from cloning.pilot.network import Network


class ServerDriver(ClientSession):
    """Sends drive.py the telemetry that the simulator would send, and returns the steering of its answers."""

    def __init__(self, host: str, port: int, wait: float):
        """wait: see ClientSession."""
        super().__init__(host, port, wait)
        self.steering = self.throttle = 0.0  # as last commanded

    def __call__(self, frame: ReplayFrame) -> float:
        """Return the steering, -1..1. Raises SimulatorError if the server is missing, or silent, for too long."""
        packet = telemetry_packet(self.steering, self.throttle, frame.speed, frame.jpeg())
        while True:
            try:
                if not self.connected:
                    self.connect()
                    self.receive_greeting()
                self.receive_unasked()
                answer = self.request_answer(packet)
                break
            except ConnectionLost as error:
                self.count_reconnection(error)
                self.close()
        if answer.steering is not None and answer.throttle is not None:
            self.steering, self.throttle = answer.steering, answer.throttle
        return self.steering


class ModelDriver:
    """Steers by a model in this process, with the same arithmetic as drive.py."""

    def __init__(self, model: "str | Network"):
        """Load the model; model: its file, or the network itself. Raises ModelError."""
        import torch  # slow to import, and not needed to drive over the wire

        from cloning.pilot.network import load_model, steer

        torch.set_num_threads(1)  # other drives run at the same time
        self.network = load_model(model) if isinstance(model, str) else model
        top, bottom = self.network.crop
        self.rows = slice(top, FRAME[0] - bottom)  # of a frame, which the network sees
        self.steer = steer

    def __call__(self, frame: ReplayFrame) -> float:
        """Return the steering, -1..1. Raises SimulatorError if the network computes no finite number."""
        try:
            return float(self.steer(self.network, frame.received(self.rows)))
        except ArithmeticError as error:
            raise SimulatorError(f"{error}: train the model again") from None

    def close(self) -> None:
        """Do nothing: no connection is open."""
