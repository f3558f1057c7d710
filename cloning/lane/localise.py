"""Estimates the position in the lane at every row of a recording, by localising it on a known track if possible.

The centre lines of both tracks are known. Once a recording is localised on one, the lane's centre is known even where
no single frame shows it well. An extended Kalman filter with a Rauch-Tung-Striebel smoother localises a stretch:
steering, speed and time stamps predict the rear axle's state, and the lane's centre ahead, as detected by `reader.py`,
corrects it. The filter gives less weight to detections that are outliers. Where the track's centre is painted, more
passes add the line's detections (`marking.py`), which are several times as exact; each is linearised about the one
before, since in sharp bends over crests a filter's own prediction is too far off.
"""

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from cloning.lane import marking
from cloning.lane.ahead import centre_ahead, line_ahead
from cloning.lane.reader import (
    ANY_ROAD_WEIGHTS,
    DISTANCES_AHEAD,
    MOUNT_OFFSETS,
    LaneNetwork,
    estimate_centres,
    fuse_detections,
    load_network,
    read_strips,
)
from cloning.lane.recovery import LanePosition
from cloning.recordings.log import Recording
from cloning.road.camera import camera_position
from cloning.road.motion import AXLE_TO_CAMERA, REAR_AXLE, Stretch, wrap_angle
from cloning.road.track import ROADS, Track

MEASUREMENT_NOISE = 0.3 + 0.08 * DISTANCES_AHEAD  # standard deviation of a detection at each distance ahead, m
MARKING_NOISE = 0.02 + 0.03 * marking.DISTANCES  # likewise, of a painted line's
# The network errs alike in successive rows, so where the line is found, up to so many rows away, its noise counts more.
LINE_ROWS, BESIDE_LINE = 40, 8.0
OUTLIER_THRESHOLD = 2.0  # standard deviations beyond which a detection gets less weight
MISSING_DETECTION = 3.0  # standard deviations that are counted where the track is out of the camera's view
# Process noise: standard deviations of (s, lateral offset, heading error) that each row adds: per metre driven, per
# radian turned (a car that turns hard slides), and per row.
NOISE_PER_METRE, NOISE_PER_RADIAN = np.array([0.03, 0.02, 0]), np.array([0, 0.4, 0.2])
NOISE_PER_ROW = np.array([0, 0, 0.003])
# Covariance of the state at a candidate position: m², m², radians²; candidates are up to 4 m off along the track.
INITIAL_COVARIANCE = np.diag([4.0**2, 4.0, 0.05])
SLOPE_STEP = 0.5  # m before and behind a distance ahead, over which the centre line's slope is taken
NEIGHBOURS = np.array([[0], [-SLOPE_STEP], [SLOPE_STEP]])
PROFILE_LENGTH, PROFILE_STEP = 200.0, 2.0  # m: part of the trajectory whose heading is compared, and its step
SEARCH = ((8, 150), (2, 600))  # two rounds: number of the best candidates that the filter follows, and rows
LINE_ROUNDS = 3  # in each, the painted line is expected where the one before found it
# A shorter stretch may resemble a bend of any track.
MIN_LOCALISED_ROWS = 300
# Stretches of 300 rows of real recordings have -0.25 to 0 on their own track, -0.45 or less on the other.
MIN_LOG_LIKELIHOOD = -0.35
# Real recordings and rendered drives have 0.12 to 0.33 on the lake and 0.56 to 0.92 in the jungle. Laps of generated
# roads, which a position on a track can follow nearly as well, have at least 1.5; 315 m along the middle of gentle ones
# at least 0.67. Of 135 m along the middle, a quarter of the roads still has less than 0.5.
MAX_TURN_RESIDUAL = {"lake": 0.5, "jungle": 1.2}

Strips = Callable[[slice], np.ndarray]  # returns those of the three cameras in rows of a recording, as `read_strips`


@dataclass(frozen=True)
class Localisation:
    """The result of localising a stretch of a recording on a known track.

    track           in the direction driven
    states          float64 (n, 3): the rear axle's state in each row: s, m along the track; lateral offset, m to the
                    right of its centre line; heading error, radians to its right
    log_likelihood  of a detection, on average, for a Cauchy distribution: 0 where detections agree with the track,
                    -2.3 where they have nothing to do with it
    turn_residual   root mean square of the changes of the heading error that neither steering nor the track explains,
                    in standard deviations of the process noise: below 1 on the right track, where the car turns as it
                    steers
    """

    track: Track
    states: np.ndarray
    log_likelihood: float
    turn_residual: float

    def is_certain(self) -> bool:
        """Return whether the stretch certainly is on this track."""
        likely = self.log_likelihood > MIN_LOG_LIKELIHOOD
        return likely and self.turn_residual < MAX_TURN_RESIDUAL[self.track.name]


class TrackFilter:
    """The extended Kalman filter that follows a stretch along a track; its state is as in `Localisation`."""

    def __init__(self, stretch: Stretch, centres: np.ndarray, track: Track, marks: np.ndarray | None = None) -> None:
        """Prepare a stretch's motion and measurements.

        centres: float32 (n, 3, 5), of `reader.detect_centres`; marks: float (n, 3), m from the centre camera to the
        painted line at `marking.DISTANCES`, nan where none was found; None: the line is not measured.
        """
        self.track, self.step, self.turn = track, np.diff(stretch.driven), np.diff(stretch.heading)
        self.slip = stretch.slip
        noise = NOISE_PER_METRE * self.step[:, None] + NOISE_PER_RADIAN * np.abs(self.turn)[:, None] + NOISE_PER_ROW
        self.process_noise = noise[:, :, None] ** 2 * np.eye(3)
        self.measured = np.median(centres + MOUNT_OFFSETS[:, None], axis=1)
        self.has_marks = marks is not None
        self.distances, self.noise = DISTANCES_AHEAD, np.tile(MEASUREMENT_NOISE, (len(stretch), 1))
        if marks is not None:
            self.measured = np.concatenate([self.measured, marks], axis=1)
            self.distances = np.r_[DISTANCES_AHEAD, marking.DISTANCES]
            marked = ~np.isnan(marks).all(1)
            self.noise[np.convolve(marked, np.ones(2 * LINE_ROWS + 1), "same") > 0.5] *= BESIDE_LINE
            self.noise = np.concatenate([self.noise, np.tile(MARKING_NOISE, (len(stretch), 1))], axis=1)

    def curvature(self, s: float) -> float:
        """Return the track's curvature at s, 1/m, right positive."""
        return float(self.track.curvature[round(s / self.track.step) % len(self.track.curvature)])

    def predict(self, row: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the state one row later, (3,), and its Jacobian by this one, (3, 3)."""
        s, right, yaw = state
        turn, slip, bend = self.turn[row], self.slip[row], self.curvature(s)
        step = self.step[row] / np.hypot(1, self.track.at(s).grade)  # s is the distance on the map
        slower = max(0.3, 1 - bend * right)  # on the inside of a bend the centre line is the shorter path
        along = step * np.cos(yaw + turn / 2 + slip) / slower
        road_turn = wrap_angle(self.track.at(s).heading - self.track.at(s + along).heading)
        jacobian = np.array(
            [
                [1, along * bend / slower, -step * np.sin(yaw)],
                [0, 1, step],
                [bend - self.curvature(s + along), -bend * along * bend / slower, 1],
            ]
        )
        moved = s + along, right + step * np.sin(yaw + (turn - road_turn) / 2 + slip), yaw + turn - road_turn
        return np.array(moved), jacobian

    def camera_at(self, state: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the centre camera's x and y, (2,), m, and its heading, radians."""
        s, right, yaw = state
        axle = self.track.at(s, right)
        heading = axle.heading - yaw
        return camera_position(np.array([axle.x, axle.y]), np.array([np.cos(heading), np.sin(heading)])), heading

    def lines_at(self, states: np.ndarray, distances: np.ndarray) -> np.ndarray:
        """Return where the line along the centre is seen at n states, (n, 3): float64 (n, 2, k); see `line_ahead`."""
        return np.array([line_ahead(self.track, state[0], *self.camera_at(state), distances) for state in states])

    def expect(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the expected measurement, (k,), and its Jacobian by the state, (k, 3); nan out of sight."""
        s, right, yaw = state
        camera = self.camera_at(state)
        seen, factor = centre_ahead(self.track, s, *camera, DISTANCES_AHEAD + NEIGHBOURS), np.ones(len(DISTANCES_AHEAD))
        if self.has_marks:
            line, factors = line_ahead(self.track, s, *camera, marking.DISTANCES + NEIGHBOURS)
            seen, factor = np.concatenate([seen, line], axis=1), np.r_[factor, factors[0]]
        centre, before, after = seen
        slope = (after - before) / (2 * SLOPE_STEP)
        bend = self.curvature(s)
        by_yaw = -(self.distances + AXLE_TO_CAMERA * factor) - slope * centre  # the car turns about its rear axle
        by_s = (1 - bend * right) * (slope * np.cos(yaw) + np.sin(yaw)) * factor + bend * by_yaw
        return centre, np.stack([by_s, (slope * np.sin(yaw) - np.cos(yaw)) * factor, by_yaw], axis=1)


class Candidate:
    """A candidate position in a stretch's first row, which a filter follows along the track row by row."""

    def __init__(self, follower: TrackFilter, s: float) -> None:
        """s: m along the track."""
        self.follower, self.s, self.log_likelihood = follower, s, 0.0
        # Means and covariances of the states: predicted, with the Jacobian that led to it, and corrected.
        self.predicted: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.filtered: list[tuple[np.ndarray, np.ndarray]] = []

    def follow(self, end: int, around: np.ndarray | None = None) -> float:
        """Filter the rows before `end` that are still to do; return a detection's log-likelihood, on average.

        around: states of all rows, (n, 3), about which to linearise, of an earlier `smooth`; None: the filter's own.
        """
        follower = self.follower
        for row in range(len(self.filtered), end):
            x, p, f = np.array([self.s, 0.0, 0.0]), INITIAL_COVARIANCE, np.eye(3)
            if row:
                x, p = self.filtered[-1]
                about = x if around is None else around[row - 1]
                moved, f = follower.predict(row - 1, about)
                x = moved + f @ (x - about)
                p = f @ p @ f.T + follower.process_noise[row - 1]
            self.predicted.append((x, p, f))
            about = x if around is None else around[row]
            expected, jacobian = follower.expect(about)
            measured, noise = follower.measured[row], follower.noise[row]
            visible = ~np.isnan(jacobian[:, 0])
            counted = ~np.isnan(measured)
            # By a distribution of twice the noise's width.
            error = np.where(visible, (measured - expected) / (2 * noise), MISSING_DETECTION)[counted]
            self.log_likelihood -= float(np.log1p(error * error).sum()) / len(error)
            for k in np.flatnonzero(visible & counted):
                h = jacobian[k]
                spread = p @ h
                innovation = float(measured[k] - expected[k] - h @ (x - about))
                variance, variance_measured = float(h @ spread), float(noise[k]) ** 2
                outlier = max(1.0, innovation**2 / (variance + variance_measured) / OUTLIER_THRESHOLD**2)
                gain = spread / (variance + variance_measured * outlier)
                x, p = x + gain * innovation, p - gain[:, None] * spread
            self.filtered.append((x, p))
        return self.log_likelihood / end

    def smooth(self) -> np.ndarray:
        """Return the states of the rows that were filtered, each corrected by the later ones: float64 (n, 3)."""
        states = [self.filtered[-1][0]]
        for (x, p), (y, q, f) in zip(self.filtered[-2::-1], self.predicted[:0:-1], strict=True):
            states.append(x + p @ f.T @ np.linalg.solve(q, states[-1] - y))
        return np.array(states[::-1])

    def turn_residual(self, states: np.ndarray) -> float:
        """Return that of `Localisation`; states: of `smooth`."""
        before, after = (np.array([step[0] for step in steps]) for steps in (self.filtered[:-1], self.predicted[1:]))
        jacobian = np.array([f[2] for _, _, f in self.predicted[1:]])
        expected = after[:, 2] + (jacobian * (states[:-1] - before)).sum(1)
        variance = self.follower.process_noise[: len(expected), 2, 2]
        return float(np.sqrt(np.mean((states[1:, 2] - expected) ** 2 / variance)))


def candidate_positions(follower: TrackFilter) -> list[tuple[float, float]]:
    """Find positions on the track at which the road bends like the stretch; only local minima of the deviation.

    Returns (deviation, s): the standard deviation of the difference in heading, radians, and m along the track.
    """
    driven = np.r_[0, np.cumsum(follower.step)]
    wanted = np.arange(0, min(PROFILE_LENGTH, driven[-1]), PROFILE_STEP)
    heading = np.interp(wanted, driven, np.r_[0, np.cumsum(follower.turn)])
    track = follower.track
    n = round(track.length / PROFILE_STEP)
    two_laps = np.r_[track.heading, track.heading + track.turns(), track.heading[0] + 2 * track.turns()]
    resampled = np.interp(np.arange(n + len(wanted)) * PROFILE_STEP, np.arange(len(two_laps)) * track.step, two_laps)
    deviation = (np.lib.stride_tricks.sliding_window_view(resampled, len(wanted))[:n] + heading).std(1)
    minima = (deviation <= np.roll(deviation, 1)) & (deviation < np.roll(deviation, -1))
    return [(float(deviation[i]), i * PROFILE_STEP) for i in np.flatnonzero(minima)]


def localise(stretch: Stretch, centres: np.ndarray) -> Localisation:
    """Localise a stretch on the track and direction that it fits best.

    centres: float32 (n, 3, 5): of `reader.detect_centres`, in the stretch's rows.
    """
    filters = [TrackFilter(stretch, centres, Track(name, direction)) for name in ROADS for direction in ("ccw", "cw")]
    candidates = [(badness, Candidate(each, s)) for each in filters for badness, s in candidate_positions(each)]
    for count, rows in SEARCH:
        best = sorted(candidates, key=lambda candidate: candidate[0])[:count]
        candidates = [(-candidate.follow(min(rows, len(stretch))), candidate) for _, candidate in best]
    _, found = min(candidates, key=lambda candidate: candidate[0])
    log_likelihood, states = found.follow(len(stretch)), found.smooth()
    return Localisation(found.follower.track, states, log_likelihood, found.turn_residual(states))


def line_deviations(expected: np.ndarray, stretch: Stretch, strips: Strips) -> np.ndarray:
    """Return how far right of a stretch's expected centre line a painted one is found: float64 (n, 3), m.

    expected: float64 (n, 2, k), of `TrackFilter.lines_at`, at `marking.AHEAD`. See `marking.find_lines`. Raises
    RecordingError for unreadable images.
    """
    found = []
    for start in range(0, len(expected), marking.ROWS_AT_ONCE):
        part, first = expected[start : start + marking.ROWS_AT_ONCE], stretch.rows.start + start
        found.append(marking.find_lines(strips(slice(first, first + len(part))), part))
    return np.concatenate(found)


def follow_line(localisation: Localisation, stretch: Stretch, centres: np.ndarray, strips: Strips) -> Localisation:
    """Return the localisation of a stretch, corrected by the line that is painted along the track's centre.

    centres: as for `localise`. Raises RecordingError for unreadable images.
    """
    follower = TrackFilter(stretch, centres, localisation.track)
    for _ in range(LINE_ROUNDS):
        centre = follower.lines_at(localisation.states, np.r_[marking.AHEAD, marking.DISTANCES])
        expected, near = centre[..., : len(marking.AHEAD)], centre[:, 0, len(marking.AHEAD) :]
        found = marking.supported(line_deviations(expected, stretch, strips))
        follower = TrackFilter(stretch, centres, localisation.track, near + found)
        again = Candidate(follower, localisation.states[0, 0])
        again.follow(len(stretch), localisation.states)
        localisation = replace(localisation, states=again.smooth())
    return localisation


def localise_all(stretches: list[Stretch], centres: np.ndarray, strips: Strips) -> Iterator[tuple[slice, Localisation]]:
    """Yield the rows and localisation of each stretch of a recording that is certainly on a known road.

    centres: float32 (n, 3, 5): of `reader.detect_centres`, in the recording's rows.
    """
    for stretch in stretches:
        if len(stretch) >= MIN_LOCALISED_ROWS:
            detected = centres[stretch.rows]
            localisation = localise(stretch, detected)
            if localisation.is_certain():
                if ROADS[localisation.track.name].centre_line:
                    localisation = follow_line(localisation, stretch, detected, strips)
                yield stretch.rows, localisation


def localise_recording(
    recording: Recording,
    stretches: list[Stretch],
    detect: Callable[[LaneNetwork], np.ndarray],
    strips: Strips,
    networks: Iterable[LaneNetwork],
) -> tuple[LanePosition, list[tuple[slice, Localisation]]]:
    """Return the position in the lane at every row of a recording, and what `localise_all` yields for it.

    Where a stretch is on a known road, the position is from its localisation; elsewhere `reader.fuse_detections` gives
    it. If no stretch is on one by a network's detections, the next network is tried; after the last one, those
    detections count that are trusted in most rows.

    stretches: of the recording; detect: returns what `reader.detect_centres` does with a network.
    """
    positions = []
    for network in networks:
        centres = detect(network)
        position = fuse_detections(recording, centres)
        if localised := list(localise_all(stretches, centres, strips)):
            for rows, localisation in localised:
                _, offset, heading_error = localisation.states.T
                position.lateral_offset[rows] = offset + REAR_AXLE * np.sin(heading_error)
                position.heading_error[rows], position.trusted[rows] = heading_error, True
            return position, localised
        positions.append(position)
    return max(positions, key=lambda position: position.trusted.sum()), []


def shipped_networks() -> Iterator[LaneNetwork]:
    """Yield the networks that come with the project: for the known tracks, then for any road. Raises ModelError."""
    return map(load_network, (None, ANY_ROAD_WEIGHTS))


def estimate_lane_position(
    recording: Recording, stretches: list[Stretch], network: LaneNetwork | None = None
) -> LanePosition:
    """Estimate the position in the lane at every row of a recording, as `localise_recording` does.

    stretches: of the recording, `motion.stretches`; network: to use instead of the two that come with the project.
    Raises RecordingError for images that can't be read, ModelError without a usable network.
    """
    strips = read_strips(recording)
    networks = [network] if network else shipped_networks()
    detect = functools.partial(estimate_centres, strips)
    return localise_recording(recording, stretches, detect, strips.__getitem__, networks)[0]
