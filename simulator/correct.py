"""Corrections: drive.py drives, the expert takes over where the car is off the lane's centre, and is recorded there.

So the network learns, where it gets to by its own faults, how to come back. This is the idea of DAgger (Ross et al.
2011, arXiv 1011.0686), with an expert that drives only where it must (as HG-DAgger does, arXiv 1810.02890).
"""

import math

from cloning.base.outputs import plural
from cloning.recordings.writer import RecordingWriter
from cloning.road.disturbances import Disturbance
from cloning.road.motion import MPH
from cloning.wire.client import MANUAL_TELEMETRY
from simulator.cameras import Cameras
from simulator.car import STEP
from simulator.client import Client
from simulator.expert import Expert
from simulator.record import write_row
from simulator.run import Run
from simulator.world import Scene

TOO_FAR = 1.0  # m from the lane's centre at which the expert takes over, as the human does in NVIDIA's evaluation
# It hands back after two seconds this near to the centre and this well aligned with it. In the jungle it is so itself
# some 95 % of the time (up to 0.73 m and 7.3° at 15 mph, 0.74 m and 8.3° at 30 mph). --robust uses no shorter drive.
NEAR, ALIGNED, NEAR_TIME = 0.75, math.radians(8), 2.0  # m, radians, s


class CorrectedClient(Client):
    """Drives as drive.py answers, but as the expert does in corrections, which are recorded.

    A correction also ends when the car leaves the road in spite of the expert and is set back. Each is a drive of its
    own in the recording. As in the real simulator while a person drives, the telemetry is then null.

    corrections  how many there were
    expert_time  simulated seconds that the expert has driven
    """

    def __init__(
        self,
        run: Run,
        scene: Scene,
        speed: float,
        recording: RecordingWriter,
        host: str,
        port: int,
        wait: float,
        disturbance: Disturbance | None = None,
    ):
        """speed: the expert's set speed in mph, which the car never exceeds; wait: see ClientSession.

        disturbance: of what drive.py sees, and of what is recorded.
        """
        super().__init__(run, Cameras(scene, ("center",), disturbance), host, port, wait, realtime=False)
        run.car.speed_limit = speed * MPH
        self.recording, self.recorded = recording, Cameras(scene, disturbance=disturbance)
        self.expert = Expert(run.track, top_speed=speed * MPH, wander=0.0)
        self.correcting, self.corrections, self.expert_time = False, 0, 0.0
        self._away_at = 0.0  # simulated seconds when the car was last not near the centre, in a correction
        self._recorded_at = -1.0  # simulated seconds of the last row

    def next_frame(self) -> str:
        """Decide who drives until the next frame, record what the expert drove, and return the telemetry packet."""
        run = self.run
        if self.correcting and run.time > self._recorded_at:  # not again after a reconnection
            write_row(self.recording, self.recorded, run)
            self._recorded_at = run.time
        offset, heading_error = run.lane
        if not self.correcting and abs(offset) > TOO_FAR:
            self.correcting = True
            self.corrections += 1
            self.recording.begin_drive()
            for cameras in (self.cameras, self.recorded):  # no late frame is of the drive before
                cameras.disturb(cameras.disturbance)
            self._away_at = run.time
        elif abs(offset) > NEAR or abs(heading_error) > ALIGNED:
            self._away_at = run.time
        elif run.time - self._away_at >= NEAR_TIME:
            self.correcting = False
        return MANUAL_TELEMETRY if self.correcting else super().next_frame()

    def step(self) -> None:
        """Drive for one physics step. Raises SimulatorError if the car stands still."""
        commands = self.expert.drive(self.run)  # all the time, so that its steering has settled when it takes over
        if self.correcting:
            self.steering, self.throttle = commands
            self.expert_time += STEP
        departures, at_end = len(self.run.departures), self.run.at_end
        super().step()
        if at_end or len(self.run.departures) > departures:
            self.correcting = False

    def summary(self) -> str:
        """Return a line about the corrections."""
        share = 100 * self.expert_time / self.run.time if self.run.time else 0.0
        recorded = f"{plural(self.recording.rows, 'row')} in {self.recording.folder}"
        recorded = recorded if self.recording.rows else "nothing was recorded"
        return f"corrections: {self.corrections}, the expert drove {share:.1f} % of the time; {recorded}"
