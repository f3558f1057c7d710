"""Where the centre line of a known track lies ahead of a camera, and where it is seen if the road is not flat."""

import numpy as np

from cloning.lane.reader import DISTANCES_AHEAD
from cloning.road.camera import CAMERA_HEIGHT
from cloning.road.motion import AXLE_TO_CAMERA, WHEELBASE
from cloning.road.track import Track

VISIBLE_POINTS = np.arange(-6, 40)  # indices, relative to the car, of a track's points that the camera may see
MIN_BELOW = 1e-3  # m below the camera: higher ground, beyond a dip, is not seen as ground


def centre_ahead(
    track: Track, s: float, camera: np.ndarray, heading: float, distances: np.ndarray = DISTANCES_AHEAD
) -> np.ndarray:
    """Return where a track's centre line lies ahead of a camera: float64 (…), m to its right.

    s: m along the track near which to look; camera: (2,), its x and y, m; heading: radians, as the track's;
    distances: (…), m ahead of the camera. The result is nan beyond the point at which the track turns back.
    """
    right, forward, _ = _points_ahead(track, s, camera, heading)
    return _until_it_turns_back(distances, forward, right)[0]


def line_ahead(track: Track, s: float, camera: np.ndarray, heading: float, distances: np.ndarray) -> np.ndarray:
    """Return where a line along a track's centre is seen ahead of a camera, as if the ground were flat: float64 (2, …).

    Where the road falls away, as beyond a crest, a line is seen nearer than it is, and nearer to the camera's middle;
    where it rises, further. The first row of the result is as that of `centre_ahead`, the second the factor by which
    distances seem larger than they are; both are nan also where a crest hides the line.

    s: m along the track, of the car's rear axle; both axles are on the road. Other arguments: as of `centre_ahead`.
    """
    right, forward, height = _points_ahead(track, s, camera, heading)
    rear, front = track.at(s).z, track.at(s + WHEELBASE).z
    run, rise = np.array([WHEELBASE, front - rear]) / np.hypot(WHEELBASE, front - rear)  # of the car
    along, above = forward + AXLE_TO_CAMERA, height - rear
    forward, above = along * run + above * rise - AXLE_TO_CAMERA, above * run - along * rise
    right, forward, above = np.array([right, forward, above])[:, forward > 0]
    factor = CAMERA_HEIGHT / np.maximum(CAMERA_HEIGHT - above, MIN_BELOW)
    return _until_it_turns_back(distances, forward * factor, right * factor, factor)


def _points_ahead(
    track: Track, s: float, camera: np.ndarray, heading: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centre line's points near s: float64 (n,) each, m to the camera's right, ahead of it, and z."""
    x, y, z = track.points[(round(s / track.step) + VISIBLE_POINTS) % len(track.points)].T
    x, y, cos, sin = x - camera[0], y - camera[1], np.cos(heading), np.sin(heading)
    return x * sin - y * cos, x * cos + y * sin, z  # as `components`, which also copies: this is called for each row


def _until_it_turns_back(distances: np.ndarray, forward: np.ndarray, *values: np.ndarray) -> np.ndarray:
    """Interpolate values, (n,) each, at distances ahead between n points of a line: float64 (values, …).

    The result is nan beyond the first point that is no further ahead than the one before.
    """
    back = forward[1:] <= forward[:-1]
    end = back.argmax() + 1 if back.any() else len(forward)
    return np.array([np.interp(distances, forward[:end], each[:end], right=np.nan) for each in values])
