"""Who steers a replay: drive.py over the wire, or a model in this process."""

from cloning.errors import SimulatorError
from cloning.recordings.images import decode
from cloning.replay.replay import Moment
from cloning.wire.client import Gone, telemetry
from cloning.wire.session import ClientSession


class Served(ClientSession):
    """drive.py steers, and is told what the simulator would tell it."""

    def __init__(self, host: str, port: int, wait: float):
        super().__init__(host, port, wait)
        self.steering = self.throttle = 0.0

    def __call__(self, moment: Moment) -> float:
        """Steering, -1..1. Raises SimulatorError when patience is at its end."""
        packet = telemetry(self.steering, self.throttle, moment.speed, moment.jpeg())
        while True:
            try:
                if self.wire is None:
                    self.wire = self.connect()
                    self.listen()
                self.early()
                answer = self.exchange(packet)
                break
            except Gone as error:
                self.reconnect(error)
                self.close()
        if answer.steering is not None:
            self.steering, self.throttle = answer.steering, answer.throttle
        return self.steering


class InProcess:
    """A model steers by the same arithmetic as drive.py, without the wire."""

    def __init__(self, model: str):
        """Raises SimulatorError for an unusable model file."""
        import torch  # large, and not needed over the wire

        from cloning.errors import ModelError
        from cloning.pilot.network import load_model, steer

        torch.set_num_threads(1)
        try:
            self.network = load_model(model)
        except ModelError as error:
            raise SimulatorError(str(error)) from None
        self.steer = steer

    def __call__(self, moment: Moment) -> float:
        """Steering, -1..1. Raises SimulatorError."""
        try:
            return float(self.steer(self.network, decode(moment.jpeg())))
        except ArithmeticError as error:
            raise SimulatorError(f"{error}: train the model again") from None

    def close(self) -> None:
        """Nothing is open."""
