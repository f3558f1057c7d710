"""Replay a recording as if a model drove it: NVIDIA's evaluation (arXiv 1604.07316, section 6).

The driver (a model) is shown each recorded frame as the camera would see it from the car's pose, which is integrated
from the difference between the model's steering and the human driver's. When the car is further from the reference line
than a limit, it is set back onto the line and an intervention is counted.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cloning.base.errors import RecordingError
from cloning.lane.recovery import LaneAhead, LanePosition
from cloning.recordings.check import check_images
from cloning.recordings.format import DRIVING_LOG
from cloning.recordings.images import compress, compressed_rows, encode
from cloning.recordings.log import CheckedRecording, Recording, print_findings, read_recording
from cloning.replay.views import StretchViews
from cloning.road.autonomy import autonomy
from cloning.road.camera import VIEW_JPEG_QUALITY
from cloning.road.disturbances import Disturbance, Disturber
from cloning.road.motion import (
    MIN_STRETCH_ROWS,
    MIN_TRUSTED,
    MPH,
    OFF_ROAD,
    REAR_AXLE,
    Stretch,
    curvature,
    lagged_curvature,
    stretches,
)

MAX_YAW_FROM_HUMAN = 1.2  # radians: views further to the side cannot be warped from the frames


class NothingToReplay(RecordingError):
    """A recording of which nothing can be replayed."""


@dataclass(frozen=True)
class ReferenceLine:
    """The line from which lateral offsets are measured, over one stretch of a recording."""

    stretch: Stretch  # of the recording, or a part of one
    offset: np.ndarray  # float64 (n,): m from the line to the human driver's car, right positive
    # float64 (n,): radians from the line's direction beside the rear axle to the human driver's heading, right positive
    yaw: np.ndarray
    is_lane_centre: bool  # if not, the line is the human driver's path, and offset and yaw are 0
    placed: int  # rows in which the lane is not read from single frames: see `LanePosition`
    ahead: LaneAhead  # the lane ahead at each row, along the same line, known or extended

    @staticmethod
    def human_path(stretch: Stretch) -> "ReferenceLine":
        """Return the human driver's path over a stretch."""
        zeros = np.zeros(len(stretch))
        ahead = LaneAhead.of_stretch(stretch, zeros, zeros.astype(bool)).extended()
        return ReferenceLine(stretch, zeros, zeros, is_lane_centre=False, placed=0, ahead=ahead)

    @property
    def rows(self) -> slice:
        """The rows of the recording."""
        return self.stretch.rows


@dataclass
class Drive:
    """The result of one replay of a recording at one limit; each list has an entry per row driven."""

    limit: float  # m from the reference line
    row: list[int] = field(default_factory=list)  # of the recording
    seconds: list[float] = field(default_factory=list)  # since the previous row of the same stretch
    offset: list[float] = field(default_factory=list)  # m from the reference line, right positive
    offset_from_human: list[float] = field(default_factory=list)  # m from the human driver's path, right positive
    steering: list[float] = field(default_factory=list)  # the driver's, -1..1
    human_steering: list[float] = field(default_factory=list)  # -1..1
    interventions: dict[int, float] = field(default_factory=dict)  # entry at which the car was set back -> offset, m

    def autonomy(self) -> float:
        """Return NVIDIA's measure; see `autonomy.autonomy`."""
        return autonomy(len(self.interventions), sum(self.seconds))

    def cut(self, rows: int) -> None:
        """Forget all but the first rows."""
        for column in (self.row, self.seconds, self.offset, self.offset_from_human, self.steering, self.human_steering):
            del column[rows:]
        self.interventions = {at: offset for at, offset in self.interventions.items() if at < rows}


def load_recording(folder: str | Path) -> CheckedRecording:
    """Read a recording without unusable rows, which are printed, and without repetitions of the row before.

    Raises RecordingError if the recording cannot be read, NothingToReplay if no row is left.
    """
    recording = check_images(read_recording(folder))
    print_findings(recording)
    if not len(recording):
        raise NothingToReplay(f"{recording.folder / DRIVING_LOG}: no usable row is left to replay")
    return recording.without_copies()


def reference_lines(recording: Recording, by_lane: bool = True) -> list[ReferenceLine]:
    """Return the reference lines of the stretches to replay.

    by_lane: use the lane centre in pieces in which it is known or its estimate is trusted, and leave out mishaps and
    the parts in which the human driver is off the road; in other pieces, and if not by_lane, use the human driver's
    path.
    Raises NothingToReplay if there is no stretch to replay.
    """
    driven, lines = stretches(recording), list[ReferenceLine]()
    if by_lane:
        from cloning.lane.known import lane_position  # imports torch

        lane = lane_position(recording, driven)
        parts = [part for stretch in driven for part in lane.pieces(recording, stretch)]
        lines = [line for part in parts for line in _lines_of(recording, part, lane.take(part.rows))]
    else:
        lines = [ReferenceLine.human_path(stretch) for stretch in driven]
    if not lines:
        nothing = "no two seconds of driving without a break to replay, all faster than 2 mph; record more"
        raise NothingToReplay(f"{recording.folder}: {nothing}")
    return lines


def _lines_of(recording: Recording, stretch: Stretch, lane: LanePosition) -> list[ReferenceLine]:
    """Return the reference lines of a stretch; lane: the position in the lane in its rows."""
    if lane.trusted.mean() < MIN_TRUSTED:
        return [ReferenceLine.human_path(stretch)]
    ahead = LaneAhead.of_stretch(stretch, lane.lateral_offset, lane.trusted).extended()
    every, known, sure = np.arange(len(lane)), np.flatnonzero(lane.trusted), lane.take(lane.trusted)
    offset, yaw = (np.interp(every, known, column) for column in (sure.lateral_offset, sure.heading_error))
    # The estimate is beside the car's middle. It is set back along the lane beside its rear axle, which is less turned.
    yaw += REAR_AXLE * curvature(ahead.steering(0, 0))
    lines = []
    changes = np.flatnonzero(np.diff(np.r_[False, np.abs(offset) < OFF_ROAD, False]))  # onto the road, and off it
    for start, end in changes.reshape(-1, 2).tolist():
        if end - start >= MIN_STRETCH_ROWS:
            first, rows = stretch.rows.start, slice(start, end)
            part = Stretch.of(recording, slice(first + start, first + end))
            placed = int(lane.placed[rows].sum())
            lines.append(ReferenceLine(part, offset[rows], yaw[rows], True, placed, ahead.take(rows)))
    return lines


class ReplayedCar:
    """The pose of the driver's car relative to the human driver's, integrated over the rows of a stretch.

    right: m from the human driver's rear axle to the car's, right positive; yaw: radians to the human driver's heading.
    """

    def __init__(self, recording: Recording, line: ReferenceLine):
        rows = line.rows
        self.line = line
        self.speed = recording.speed[rows].astype(float) * MPH  # m/s, the human driver's
        self.human_steering = recording.steering[rows].astype(float)
        self.seconds = np.diff(recording.time[rows])
        self.right = self.yaw = 0.0
        # Curvatures driven, 1/m: both lag behind the steering in the same way.
        self.human_curvature = self.curvature = float(curvature(self.human_steering[0]))

    def __len__(self) -> int:
        return len(self.human_steering)

    def offset_from_human(self) -> float:
        """Return the offset of the car's middle from the human driver's path, m."""
        return self.right + REAR_AXLE * np.sin(self.yaw)

    def offset(self, at: int) -> float:
        """Return the offset of the car's middle from the reference line at a row of the stretch, m."""
        return float(self.line.offset[at] + self.offset_from_human())

    def set_back(self, at: int) -> None:
        """Put the car onto the reference line and along it, with the human driver's curvature.

        If the line is the human driver's path, the pose is then exactly the human driver's.
        """
        self.curvature = self.human_curvature
        self.yaw = float(-self.line.yaw[at])
        self.right = float(-self.line.offset[at] - REAR_AXLE * np.sin(self.yaw))

    def move(self, at: int, steering: float) -> None:
        """Drive from a row to the next one, next to the human driver: on the inside of a bend more slowly."""
        seconds = float(self.seconds[at])
        human = float(curvature(self.human_steering[at]))
        self.human_curvature = lagged_curvature(self.human_curvature, human, seconds)
        self.curvature = lagged_curvature(self.curvature, float(curvature(steering)), seconds)
        human_step = self.speed[at] * seconds
        step = human_step * (1 - self.human_curvature * self.right) / np.cos(self.yaw)
        turn = self.curvature * step - self.human_curvature * human_step
        self.right += step * np.sin(self.yaw + turn / 2)
        self.yaw = float(np.clip(self.yaw + turn, -MAX_YAW_FROM_HUMAN, MAX_YAW_FROM_HUMAN))


class ReplayFrame:
    """What a driver is given at one row: speed, time, and the view from the car's pose, warped at its first use."""

    def __init__(
        self, recording: Recording, views: StretchViews, car: ReplayedCar, at: int, disturber: Disturber | None = None
    ):
        self.views, self.at, self.pose, self.disturber = views, at, (car.right, car.yaw), disturber
        self.line, first = car.line, car.line.rows.start
        self.row = first + at
        self.speed = float(recording.speed[self.row])  # mph
        self.time = float(recording.time[self.row] - recording.time[first])  # s since the line's first row
        self.human_steering = float(car.human_steering[at])  # -1..1

    @functools.cached_property
    def view(self) -> np.ndarray:
        """The view from the car, disturbed if it is to be, uint8 (160, 320, 3), RGB."""
        view = self.views.view_from(self.at, *self.pose) if any(self.pose) else self.recorded
        return self.disturber(view) if self.disturber else view

    @property
    def recorded(self) -> np.ndarray:
        """The human driver's frame, uint8 (160, 320, 3), RGB."""
        return self.views.frame(self.at, 0)

    def jpeg(self) -> bytes:
        """Return the view as JPEG; undisturbed at the human driver's pose, the recorded file itself."""
        if not (any(self.pose) or self.disturber):
            return self.views.jpeg(self.at)
        return encode(self.view, VIEW_JPEG_QUALITY)

    def received(self, rows: slice) -> np.ndarray:
        """Return rows of `decode(self.jpeg())`, which a server receives: uint8 (k, 320, 3), RGB; only these are made.

        rows: of the frame.
        """
        made = compressed_rows(rows)
        if self.disturber:
            return compress(self.view[made], rows, VIEW_JPEG_QUALITY)
        if not any(self.pose):
            return self.recorded[rows]
        return compress(self.views.view_from(self.at, *self.pose, made), rows, VIEW_JPEG_QUALITY)

    def recovery_steering(self) -> float:
        """Return the recovery steering from the car's pose, -1..1: the label of `model.py --robust`.

        The lane ahead is that of the reference line, so the human driver's path where that is the reference.
        """
        right, yaw = self.pose
        ahead = self.line.ahead.take(slice(self.at, self.at + 1))
        human_yaw = float(ahead.yaw[0])
        return float(ahead.steering(ahead.offset[0] + right * np.cos(human_yaw), human_yaw + yaw)[0])


Driver = Callable[[ReplayFrame], float]  # returns steering, -1..1
Watcher = Callable[[ReplayFrame, Drive], object]
Parting = Callable[[list[Drive]], None]


class LineDrive:
    """A driver's car on its way along one reference line: drives at several limits are one until they part.

    They part where the car is beyond some of their limits, but not beyond all.
    """

    def __init__(
        self,
        recording: Recording,
        line: ReferenceLine,
        driver: Driver,
        disturbance: Disturbance | None = None,
        seed: int = 0,
    ):
        """Begin at the line's first row; disturbance, seed: of the warped frames."""
        self.recording, self.driver = recording, driver
        self.car, self.views = ReplayedCar(recording, line), StretchViews(recording, line.stretch)
        self.disturber = Disturber(disturbance, seed) if disturbance else None
        self.at = 0  # the row of the line at which the car is

    def go_on(self, drives: Sequence[Drive], watch: Watcher | None = None, part: Parting | None = None) -> None:
        """Drive to the line's end, and add the rows to all drives.

        watch: called with the last drive after each row, or None; part: called where the last drive and others part,
        before the row, with these, to which no more is added.
        """
        car = self.car
        for at in range(self.at, len(car)):
            self.at = at
            offset = car.offset(at)
            beyond = [abs(offset) > done.limit for done in drives]
            if part and beyond.count(beyond[-1]) < len(drives):
                part([done for done, is_beyond in zip(drives, beyond, strict=True) if is_beyond != beyond[-1]])
                drives = [done for done, is_beyond in zip(drives, beyond, strict=True) if is_beyond == beyond[-1]]
            if beyond[-1]:
                if at:
                    for done in drives:
                        done.interventions[len(done.row)] = offset
                car.set_back(at)
            frame = ReplayFrame(self.recording, self.views, car, at, self.disturber)
            steering = float(np.float32(self.driver(frame)))  # float32 as in the network, whatever the wire's digits
            for done in drives:
                done.row.append(frame.row)
                done.seconds.append(float(car.seconds[at - 1]) if at else 0.0)
                done.offset.append(car.offset(at))
                done.offset_from_human.append(car.offset_from_human())
                done.steering.append(steering)
                done.human_steering.append(frame.human_steering)
            if watch:
                watch(frame, drives[-1])
            if at + 1 < len(car):
                car.move(at, steering)


def drive(
    recording: Recording,
    lines: list[ReferenceLine],
    limit: float,
    driver: Driver,
    watch: Watcher | None = None,
    disturbance: Disturbance | None = None,
) -> Drive:
    """Replay a recording at one limit, in m from the reference lines.

    watch: called after each row, or None; disturbance: of the warped frames, in each stretch with another seed.
    """
    done = Drive(limit)
    for number, line in enumerate(lines):
        LineDrive(recording, line, driver, disturbance, number).go_on([done], watch)
    return done
