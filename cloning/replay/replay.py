"""A recording replayed as if a model drove it: NVIDIA's evaluation (arXiv 1604.07316, section 6).

Each recorded frame is shown as the camera would see it from where the model's steering has brought the car; where that
is, is integrated from the difference between the model's steering and the human's. Off the lane's centre by more than
a limit, the car is set back onto it and an intervention counted.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from cloning.recordings.check import check_images
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.log import Recording, read_recording
from cloning.replay.autonomy import autonomy
from cloning.replay.views import Views
from cloning.road.camera import VIEW_JPEG_QUALITY
from cloning.road.motion import MIN_TRUSTED, MPH, OFF_ROAD, REAR_AXLE, Stretch, curvature, lagged_curvature, stretches

LIMITS = (1.0, 2.5)  # m off the lane's centre: NVIDIA's, and where the car's side touches the edge line


@dataclass(frozen=True)
class Reference:
    """What off-centre is counted from, over one stretch of a recording.

    stretch: of the recording; offset, yaw: float64 (n,), the human's metres to the right of it and radians to it;
    lane: whether it is the lane's centre, or the human's own way (offset and yaw are then 0).
    """

    stretch: Stretch
    offset: np.ndarray
    yaw: np.ndarray
    lane: bool

    @property
    def rows(self) -> slice:
        return self.stretch.rows


@dataclass
class Drive:
    """One replay of a recording at one limit, an entry a row driven.

    row: of the recording; time: s, since the row before in the same stretch; distance: m to the right of the
    reference; beside: m to the right of the human; steering, human: -1..1.
    """

    limit: float
    row: list[int] = field(default_factory=list)
    time: list[float] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)
    beside: list[float] = field(default_factory=list)
    steering: list[float] = field(default_factory=list)
    human: list[float] = field(default_factory=list)
    interventions: dict[int, float] = field(default_factory=dict)  # entry at which it was set back: from how far off

    def autonomy(self) -> float:
        """NVIDIA's measure: 1 - interventions x 6 s / elapsed; negative if a human would have had to drive more than
        there was to drive."""
        return autonomy(len(self.interventions), sum(self.time))


def load(folder) -> Recording:
    """A recording with its whole rows, each once. Raises RecordingError."""
    recording = read_recording(folder)
    check_images(recording)
    recording.keep(np.r_[True, np.diff(recording.images[:, 0]) != 0])  # over-sampled rows stand beside one another
    return recording


def references(recording: Recording, by_lane: bool = True) -> list[Reference]:
    """The stretches to be driven, without those where the human is off the road, and what counts as their centre."""
    found, whole = [], stretches(recording)
    if by_lane:
        from cloning.lane.place import estimate_lane_position  # which loads torch

        lane = estimate_lane_position(recording, whole)
        offset, yaw, trusted = lane.lateral_offset, lane.heading_error, lane.trusted
    else:
        offset = yaw = trusted = np.zeros(len(recording))
    for stretch in whole:
        rows = stretch.rows
        sure = np.asarray(trusted[rows], bool)
        if sure.mean() < MIN_TRUSTED:
            n = len(stretch)
            found.append(Reference(stretch, np.zeros(n), np.zeros(n), lane=False))
            continue
        at, known = np.arange(len(sure)), np.flatnonzero(sure)
        filled = [np.interp(at, known, values[rows][sure].astype(float)) for values in (offset, yaw)]
        on_road = np.r_[False, np.abs(filled[0]) < OFF_ROAD, False]
        starts, ends = (np.flatnonzero(np.diff(on_road.astype(int)) == sign) for sign in (1, -1))
        for a, b in zip(starts.tolist(), ends.tolist(), strict=True):
            if b - a >= 2 * SAMPLE_RATE:
                part = stretch
                if b - a < len(stretch):
                    part = Stretch.of(recording, slice(rows.start + a, rows.start + b))
                found.append(Reference(part, filled[0][a:b], filled[1][a:b], lane=True))
    return found


class Course:
    """Where the car is beside the human's way, from row to row of a stretch: the state that steering moves.

    right: m of the rear axle's middle to the right of the human's; yaw: radians to the human's, right positive.
    """

    def __init__(self, recording: Recording, reference: Reference):
        rows = reference.rows
        self.reference = reference
        self.speed = np.abs(recording.speed[rows].astype(float)) * MPH
        self.human = recording.steering[rows].astype(float)
        self.pause = np.diff(recording.time[rows])
        self.right = self.yaw = 0.0
        # Curvatures driven by the human and by the car, 1/m: both lag behind the steering alike.
        self.humans = self.own = float(curvature(self.human[0]))

    def __len__(self):
        return len(self.human)

    def beside(self) -> float:
        """m of the car's middle to the right of the human's."""
        return self.right + REAR_AXLE * np.sin(self.yaw)

    def distance(self, at: int) -> float:
        return float(self.reference.offset[at] + self.beside())

    def set_back(self, at: int) -> None:
        """Onto the reference and along it, turning as the human; where that is the human's way, exactly so."""
        self.own = self.humans
        self.yaw = float(-self.reference.yaw[at])
        self.right = float(-self.reference.offset[at] - REAR_AXLE * np.sin(self.yaw))

    def go_on(self, at: int, steering: float) -> None:
        """To the next row. The car keeps abreast of the human, so that on the inside of a bend it is slower."""
        pause = float(self.pause[at])
        self.humans = lagged_curvature(self.humans, float(curvature(self.human[at])), pause)
        self.own = lagged_curvature(self.own, float(curvature(steering)), pause)
        step = self.speed[at] * pause
        own = step * (1 - self.humans * self.right) / np.cos(self.yaw)
        turned = self.own * own - self.humans * step
        self.right += own * np.sin(self.yaw + turned / 2)
        self.yaw = float(np.clip(self.yaw + turned, -1.2, 1.2))  # nobody asks for views to the back


class Moment:
    """One row's turn to steer. What the car sees is made when it is asked for."""

    def __init__(self, recording: Recording, views: Views, course: Course, at: int):
        self.views, self.at, self.pose = views, at, (course.right, course.yaw)
        self.row = course.reference.rows.start + at
        self.speed = float(recording.speed[self.row])  # mph
        self.human = float(course.human[at])  # -1..1

    @functools.cached_property
    def seen(self) -> np.ndarray:
        """uint8 (160, 320, 3), RGB."""
        return self.views.seen_from(self.at, *self.pose) if any(self.pose) else self.recorded

    @property
    def recorded(self) -> np.ndarray:
        """The human's frame, uint8 (160, 320, 3), RGB."""
        return self.views.frame(self.at, 0)

    def jpeg(self) -> bytes:
        """What the car sees; the recorded file itself where it stands where the human did."""
        if not any(self.pose):
            return self.views.jpeg(self.at)
        picture = cv2.cvtColor(self.seen, cv2.COLOR_RGB2BGR)
        return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, VIEW_JPEG_QUALITY])[1].tobytes()


def drive(
    recording: Recording,
    references: list[Reference],
    limit: float,
    steer: Callable[[Moment], float],
    watch: Callable[[Moment, Drive], None] | None = None,
) -> Drive:
    """Drive a recording by `steer`, which gives the steering, -1..1; `watch` is called after each row, if given."""
    done = Drive(limit)
    for reference in references:
        course, views = Course(recording, reference), Views(recording, reference.stretch)
        for at in range(len(course)):
            if abs(off := course.distance(at)) > limit:
                if at:
                    done.interventions[len(done.row)] = off
                course.set_back(at)
            moment = Moment(recording, views, course, at)
            steering = float(np.float32(steer(moment)))  # the network's own, however many digits the wire gave it
            done.row.append(moment.row)
            done.time.append(float(course.pause[at - 1]) if at else 0.0)
            done.distance.append(course.distance(at))
            done.beside.append(course.beside())
            done.steering.append(steering)
            done.human.append(moment.human)
            if watch:
                watch(moment, done)
            if at + 1 < len(course):
                course.go_on(at, steering)
    return done
