"""Follows a stretch of a recording along a known track, row by row: an extended Kalman filter with a smoother.

Steering, speed and time stamps predict the rear axle's state, and the lane's centre ahead, as detected by `reader.py`,
corrects it, as does a line that is painted along the centre. The filter gives less weight to detections that are
outliers.
"""

import copy

import numpy as np

from cloning.lane import marking
from cloning.lane.ahead import centre_ahead, line_ahead
from cloning.lane.reader import DISTANCES_AHEAD, MOUNT_OFFSETS
from cloning.road.camera import camera_position
from cloning.road.motion import AXLE_TO_CAMERA, Stretch, wrap_angle
from cloning.road.track import Track

MEASUREMENT_NOISE = 0.3 + 0.08 * DISTANCES_AHEAD  # standard deviation of a detection at each distance ahead, m
MARKING_NOISE = 0.02 + 0.03 * marking.DISTANCES  # likewise, of a painted line's
# The network errs alike in successive rows, so where the line is found, up to so many rows away, its noise counts more.
LINE_ROWS, BESIDE_LINE = 40, 8.0
OUTLIER_THRESHOLD = 2.0  # standard deviations beyond which a detection gets less weight
MISSING_DETECTION = 3.0  # standard deviations that are counted at most where the track is out of the camera's view
# Process noise: standard deviations of (s, lateral offset, heading error) that each row adds: per metre driven, per
# radian turned (a car that turns hard slides), and per row.
NOISE_PER_METRE, NOISE_PER_RADIAN = np.array([0.03, 0.02, 0]), np.array([0, 0.4, 0.2])
NOISE_PER_ROW = np.array([0, 0, 0.003])
# Covariance of the state at a candidate position: m², m², radians²; candidates are up to 4 m off along the track.
INITIAL_COVARIANCE = np.diag([4.0**2, 4.0, 0.05])
SLOPE_STEP = 0.5  # m before and behind a distance ahead, over which the centre line's slope is taken
NEIGHBOURS = np.array([[0], [-SLOPE_STEP], [SLOPE_STEP]])
CENTRE_DISTANCES, LINE_DISTANCES = DISTANCES_AHEAD + NEIGHBOURS, marking.DISTANCES + NEIGHBOURS


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
            near_line = np.convolve(marked, np.ones(2 * LINE_ROWS + 1))[LINE_ROWS:-LINE_ROWS]
            self.noise[near_line > 0.5] *= BESIDE_LINE
            self.noise = np.concatenate([self.noise, np.tile(MARKING_NOISE, (len(stretch), 1))], axis=1)

    def backwards(self) -> "TrackFilter":
        """Return the filter that follows the stretch from its last row to its first."""
        turned = copy.copy(self)
        turned.step, turned.turn, turned.slip = -self.step[::-1], -self.turn[::-1], self.slip[::-1]
        turned.measured, turned.noise = self.measured[::-1], self.noise[::-1]
        turned.process_noise = self.process_noise[::-1]
        return turned

    def curvature(self, s: float) -> float:
        """Return the track's curvature at s, 1/m, right positive."""
        return float(self.track.curvature[round(s / self.track.step) % len(self.track.curvature)])

    def predict(self, row: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the state one row later, (3,), and its Jacobian by this one, (3, 3)."""
        s, right, yaw = state
        turn, slip, bend, here = self.turn[row], self.slip[row], self.curvature(s), self.track.at(s)
        step = self.step[row] / np.hypot(1, here.grade)  # s is the distance on the map
        slower = max(0.3, 1 - bend * right)  # on the inside of a bend the centre line is the shorter path
        along = step * np.cos(yaw + turn / 2 + slip) / slower
        road_turn = wrap_angle(here.heading - self.track.at(s + along).heading)
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
        seen, factor = centre_ahead(self.track, s, *camera, CENTRE_DISTANCES), np.ones(len(DISTANCES_AHEAD))
        if self.has_marks:
            line, factors = line_ahead(self.track, s, *camera, LINE_DISTANCES)
            seen, factor = np.concatenate([seen, line], axis=1), np.r_[factor, factors[0]]
        centre, before, after = seen
        slope = (after - before) / (2 * SLOPE_STEP)
        bend, cos, sin = self.curvature(s), np.cos(yaw), np.sin(yaw)
        by_yaw = -(self.distances + AXLE_TO_CAMERA * factor) - slope * centre  # the car turns about its rear axle
        by_s = (1 - bend * right) * (slope * cos + sin) * factor + bend * by_yaw
        return centre, np.array([by_s, (slope * sin - cos) * factor, by_yaw]).T


def short_of_bend(measured: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return how far detections fall short of a bend beyond which the track is out of the camera's view: float (k,), m.

    In a hairpin the track turns back a few metres ahead. What is detected further ahead agrees with it if it is at
    least as far to that side as the track is where it is last seen. measured: float (k,), m to the camera's right, at
    growing distances ahead; seen: float (at most k,), likewise, the track as far as it is seen.
    """
    if not len(seen):
        return np.full(len(measured), np.inf)
    side = np.sign(seen[-1] - (seen[-2] if len(seen) > 1 else 0))
    return np.maximum(0, side * (seen[-1] - measured))


def corrected(
    x: np.ndarray, p: np.ndarray, about: np.ndarray, differences: np.ndarray, jacobian: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a state's mean and covariance, (3,) and (3, 3), corrected by k measurements, one after the other.

    about: the state at which they are linearised; differences: (k,), of what is measured from what is expected there;
    jacobian: (k, 3), of what is expected, by the state; noise: (k,), standard deviations. Computed with floats, since
    arrays of three take eight times as long.
    """
    s, right, yaw = (x - about).tolist()
    (ss, sr, sy), (_, rr, ry), (_, _, yy) = p.tolist()
    for difference, (by_s, by_right, by_yaw), deviation in zip(
        differences.tolist(), jacobian.tolist(), noise.tolist(), strict=True
    ):
        spread_s = ss * by_s + sr * by_right + sy * by_yaw
        spread_right = sr * by_s + rr * by_right + ry * by_yaw
        spread_yaw = sy * by_s + ry * by_right + yy * by_yaw
        variance, variance_measured = by_s * spread_s + by_right * spread_right + by_yaw * spread_yaw, deviation**2
        innovation = difference - (by_s * s + by_right * right + by_yaw * yaw)
        outlier = max(1.0, innovation**2 / (variance + variance_measured) / OUTLIER_THRESHOLD**2)
        total = variance + variance_measured * outlier
        gain_s, gain_right, gain_yaw = spread_s / total, spread_right / total, spread_yaw / total
        s, right, yaw = s + gain_s * innovation, right + gain_right * innovation, yaw + gain_yaw * innovation
        ss, sr, sy = ss - gain_s * spread_s, sr - gain_s * spread_right, sy - gain_s * spread_yaw
        rr, ry, yy = rr - gain_right * spread_right, ry - gain_right * spread_yaw, yy - gain_yaw * spread_yaw
    return about + np.array([s, right, yaw]), np.array([[ss, sr, sy], [sr, rr, ry], [sy, ry, yy]])


class Candidate:
    """A candidate position in a row of a stretch, which a filter follows along the track row by row.

    fits  of the rows that were filtered: how well detections agree with the track, see `Localisation.log_likelihood`
    """

    def __init__(
        self, follower: TrackFilter, state: np.ndarray, first: int = 0, covariance: np.ndarray = INITIAL_COVARIANCE
    ) -> None:
        """state, covariance: (3,) and (3, 3), in the row `first`."""
        self.follower, self.first, self.start = follower, first, (state, covariance)
        self.fits: list[float] = []
        # Means and covariances of the states: predicted, with the Jacobian that led to it, and corrected.
        self.predicted: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.filtered: list[tuple[np.ndarray, np.ndarray]] = []

    def follow(self, end: int, around: np.ndarray | None = None) -> float:
        """Filter the rows before `end` that are still to do; return a detection's log-likelihood, on average.

        around: states of all rows from the first on, (n, 3), about which to linearise, of an earlier `smooth`; None:
        the filter's own.
        """
        follower = self.follower
        for at in range(len(self.filtered), end - self.first):
            row, (x, p), f = self.first + at, self.start, np.eye(3)
            if at:
                x, p = self.filtered[-1]
                about = x if around is None else around[at - 1]
                moved, f = follower.predict(row - 1, about)
                x = moved + f @ (x - about)
                p = f @ p @ f.T + follower.process_noise[row - 1]
            self.predicted.append((x, p, f))
            about = x if around is None else around[at]
            expected, jacobian = follower.expect(about)
            measured, noise = follower.measured[row], follower.noise[row]
            visible, counted = ~np.isnan(jacobian[:, 0]), ~np.isnan(measured)
            # By a distribution of twice the noise's width.
            error = (measured - expected) / (2 * noise)
            if not visible.all():
                short = short_of_bend(measured, expected[visible]) / (2 * noise)
                error = np.where(visible, error, np.minimum(short, MISSING_DETECTION))
            error = error[counted]
            self.fits.append(-float(np.log1p(error * error).sum()) / len(error))
            used = visible & counted
            x, p = corrected(x, p, about, (measured - expected)[used], jacobian[used], noise[used])
            self.filtered.append((x, p))
        return sum(self.fits) / len(self.fits)

    def smooth(self) -> np.ndarray:
        """Return the states of the rows that were filtered, each corrected by the later ones: float64 (n, 3)."""
        states = [self.filtered[-1][0]]
        for (x, p), (y, q, f) in zip(self.filtered[-2::-1], self.predicted[:0:-1], strict=True):
            states.append(x + p @ f.T @ np.linalg.solve(q, states[-1] - y))
        return np.array(states[::-1])

    def turns(self, states: np.ndarray) -> np.ndarray:
        """Return how far the car turned otherwise than steering and track explain, before each row but the first.

        In standard deviations of the process noise: float64 (n - 1,). states: of `smooth`.
        """
        before, after = (np.array([step[0] for step in steps]) for steps in (self.filtered[:-1], self.predicted[1:]))
        jacobian = np.array([f[2] for _, _, f in self.predicted[1:]])
        expected = after[:, 2] + (jacobian * (states[:-1] - before)).sum(1)
        variance = self.follower.process_noise[self.first : self.first + len(expected), 2, 2]
        return (states[1:, 2] - expected) / np.sqrt(variance)
