"""Estimates the position in the lane at every row of a recording, by localising it on a known track if possible.

The centre lines of both tracks are known. Once a recording is localised on one, the lane's centre is known even where
no single frame shows it well. Where the track's centre is painted, more passes add the line's detections
(`marking.py`), which are several times as exact; each is linearised about the one before, since in sharp bends over
crests a filter's own prediction is too far off.
"""

import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from cloning.lane import marking
from cloning.lane.cuts import split_at_cuts
from cloning.lane.follow import Candidate, TrackFilter
from cloning.lane.parts import certain_parts
from cloning.lane.reader import (
    ANY_ROAD_WEIGHTS,
    MOUNT_OFFSETS,
    LaneNetwork,
    estimate_centres,
    fuse_detections,
    load_network,
    read_strips,
    smooth,
)
from cloning.lane.recovery import MISHAP, LanePosition
from cloning.lane.search import Localisation
from cloning.recordings.format import DRIVING_LOG
from cloning.recordings.log import Recording
from cloning.road.motion import MIN_SPEED, MPH, Stretch
from cloning.road.track import ROADS

LONGEST_MISHAP = 300  # rows: more are another road
MAX_DIFFERENCE = 0.15  # m, mean: positions by two networks that differ less agree
# Smoothed over 2 s, steering and bends correlate by 0.83 to 0.95 in 400 rows of two real and two rendered drives.
AGAINST, AGAINST_ROWS, AGAINST_SMOOTHING = -0.6, 600, 31
OUT_OF_ORDER = 0.3  # m: in the real recordings, each camera sees the lane 0.7 to 0.9 m beside the next one
SAMPLE = 50  # rows from which exchanged colours are told
# m, mean, between the cameras. In 200 rows of real recordings it is 0.03 to 0.16, and with red and blue exchanged more
# than twice that and 0.24 or more; in rendered ones up to 0.21, and at least 0.65 times as much with them exchanged.
COLOUR_ERROR = 0.2
LINE_ROUNDS = 3  # in each, the painted line is expected where the one before found it
KEPT_STRIPS = 30_000  # rows, 1.4 GB: those of longer recordings, of 200,000 rows 9 GB, are read when they are needed
DETECTED_ROWS = 1024  # at once

Strips = Callable[[slice], np.ndarray]  # returns those of the three cameras in rows of a recording, as `read_strips`


def follow_line(localisation: Localisation, stretch: Stretch, centres: np.ndarray, strips: Strips) -> Localisation:
    """Return the localisation of a stretch, corrected by the line that is painted along the track's centre.

    centres: float32 (n, 3, 5): of `reader.detect_centres`, in the stretch's rows. Raises RecordingError.
    """
    follower = TrackFilter(stretch, centres, localisation.track)
    for _ in range(LINE_ROUNDS):
        centre = follower.lines_at(localisation.states, np.r_[marking.AHEAD, marking.DISTANCES])
        expected, near = centre[..., : len(marking.AHEAD)], centre[:, 0, len(marking.AHEAD) :]
        found = []
        for start in range(0, len(expected), marking.ROWS_AT_ONCE):
            part, first = expected[start : start + marking.ROWS_AT_ONCE], stretch.rows.start + start
            found.append(marking.find_lines(strips(slice(first, first + len(part))), part))
        marks = near + marking.supported(np.concatenate(found))
        follower = TrackFilter(stretch, centres, localisation.track, marks)
        again = Candidate(follower, localisation.states[0])
        again.follow(len(stretch), localisation.states)
        localisation = replace(localisation, states=again.smooth())
    return localisation


def localise_all(
    recording: Recording, stretches: list[Stretch], centres: np.ndarray, strips: Strips
) -> Iterator[tuple[slice, Localisation]]:
    """Yield the rows and localisation of each part of a recording that certainly is on a known road.

    stretches: of the recording; centres: float32 (n, 3, 5): of `reader.detect_centres`, in the recording's rows.
    """
    for part, localisation in certain_parts(recording, split_at_cuts(recording, stretches, strips), centres):
        if ROADS[localisation.track.name].centre_line:
            localisation = follow_line(localisation, part, centres[part.rows], strips)
        yield part.rows, localisation


def localise_recording(
    recording: Recording,
    stretches: list[Stretch],
    detect: Callable[[LaneNetwork], np.ndarray],
    strips: Strips,
    networks: Iterable[LaneNetwork],
) -> tuple[LanePosition, list[tuple[slice, Localisation]]]:
    """Return the position in the lane at every row of a recording, and what `localise_all` yields for it.

    Where a part is on a known road, the position is from its localisation; elsewhere `reader.fuse_detections` gives it.
    Beside a part, fewer than LONGEST_MISHAP rows of its stretch that fit nowhere are a mishap. If no part is on one by
    a network's detections, the next network is tried. Rows that are left are on an unknown road. There the last one's
    detections count, made for any road: those of the first often agree with each other there, but are wrong. They count
    only where they agree with the last one's, too, as in a drive on a known track that is too short to be found on it.

    stretches: of the recording; detect: returns what `reader.detect_centres` does with a network.
    """
    detected, localised = list[np.ndarray](), list[tuple[slice, Localisation]]()
    piece = np.zeros(len(recording), np.int32)
    for network in networks:
        detected.append(detect(network))
        localised = localised or list(localise_all(recording, stretches, detected[-1], strips))
        piece = _pieces(len(recording), stretches, [rows for rows, _ in localised])
        if localised and all(piece[stretch.rows].all() for stretch in stretches):
            break
    placed, unknown = piece > 0, piece == 0
    if placed.all():
        offset, heading_error = np.zeros((2, len(recording)), np.float32)
        position = LanePosition.read(offset, heading_error, placed.copy())
    else:
        positions = [fuse_detections(recording, centres) for centres in detected]
        first, last = positions[0], positions[-1]
        difference = np.abs(first.lateral_offset - last.lateral_offset)[unknown]
        agree = difference.sum() < MAX_DIFFERENCE * len(difference)
        is_first = agree and first.trusted[unknown].sum() >= last.trusted[unknown].sum()
        position = first if is_first else last
    position = replace(position, placed=placed, piece=piece)
    for rows, localisation in localised:
        position.lateral_offset[rows], position.heading_error[rows] = localisation.middle().T
        position.trusted[rows] = True
    return position, localised


def _pieces(count: int, stretches: list[Stretch], parts: list[slice]) -> np.ndarray:
    """Return the number of the part, from 1, that each row is in, MISHAP, or 0 for an unknown road: int32 (count,)."""
    piece = np.zeros(count, np.int32)
    for number, rows in enumerate(parts, 1):
        piece[rows] = number
    for stretch in stretches:
        here = piece[stretch.rows]
        changes = np.flatnonzero(np.diff(np.r_[False, here == 0, False])).reshape(-1, 2) if here.any() else ()
        for start, end in changes:
            if end - start < LONGEST_MISHAP:
                here[start:end] = MISHAP
    return piece


def steers_against_bends(recording: Recording, centres: np.ndarray) -> bool:
    """Return whether a recording's steering certainly has another sign than the bends of the road that cameras see.

    centres: float32 (n, 3, 5): of `reader.detect_centres`, in the recording's rows.
    """
    bends = (centres[..., -1] - centres[..., 0]).mean(1)  # m to the right that the centre leads, relative to the car
    moving = recording.speed * MPH > MIN_SPEED
    if moving.sum() < AGAINST_ROWS:
        return False
    steering, bends = (smooth(column[moving], AGAINST_SMOOTHING) for column in (recording.steering, bends))
    deviations = steering.std() * bends.std()
    return bool(((steering - steering.mean()) * (bends - bends.mean())).mean() < AGAINST * deviations)


def cameras_exchanged(centres: np.ndarray) -> bool:
    """Return whether the cameras certainly have other names: from further left, the lane is further to the right.

    centres: float32 (n, 3, 5): of `reader.detect_centres`.
    """
    centre, left, right = centres[..., :2].mean((0, 2))
    return bool(max(right - centre, centre - left) > OUT_OF_ORDER)


def colours_exchanged(strips: np.ndarray, network: LaneNetwork) -> bool:
    """Return whether red and blue certainly are exchanged: only exchanged again, the cameras see the lane alike.

    strips: uint8 (n, 3, 32, 160, 3), of `reader.read_strips`.
    """

    def error(seen: np.ndarray) -> float:
        near = estimate_centres(seen, network)[..., :2] + MOUNT_OFFSETS[:, None]
        return float(np.abs(near[:, 1:] - near[:, :1]).mean())

    found = error(strips)
    return found > COLOUR_ERROR and found > 2 * error(np.ascontiguousarray(strips[..., ::-1]))


def shipped_networks() -> Iterator[LaneNetwork]:
    """Yield the networks that come with the project: for the known tracks, then for any road. Raises ModelError."""
    return map(load_network, (None, ANY_ROAD_WEIGHTS))


def estimate_lane_position(
    recording: Recording, stretches: list[Stretch], network: LaneNetwork | None = None
) -> LanePosition:
    """Estimate the position in the lane at every row of a recording, as `localise_recording` does.

    stretches: of the recording, `motion.stretches`; network: to use instead of the two that come with the project.
    If the steering's sign, the cameras' order or the colours are certainly wrong, it is printed. Raises RecordingError
    for images that can't be read, ModelError without a usable network.
    """
    strips: Strips = functools.partial(read_strips, recording)
    if len(recording) <= KEPT_STRIPS:
        strips = strips(slice(None)).__getitem__
    networks = [network] if network else list(shipped_networks())

    @functools.cache
    def detect(network: LaneNetwork) -> np.ndarray:
        starts = range(0, max(1, len(recording)), DETECTED_ROWS)
        return np.concatenate([estimate_centres(strips(slice(at, at + DETECTED_ROWS)), network) for at in starts])

    position, localised = localise_recording(recording, stretches, detect, strips, networks)
    log = recording.folder / DRIVING_LOG
    if not localised and steers_against_bends(recording, detect(networks[-1])):
        against = "the car steers left where the cameras see the road bend to the right, and vice versa"
        print(f"{log}: {against}: is right positive, is no image mirrored?", flush=True)
    if not len(recording):
        return position
    if cameras_exchanged(detect(networks[0])):
        exchanged = "the cameras do not see the lane as from the car's left, centre and right"
        print(f"{log}: {exchanged}: has each image the name of its camera, is none mirrored?", flush=True)
    sample = np.unique(np.linspace(0, len(recording) - 1, SAMPLE).astype(int))
    if colours_exchanged(np.concatenate([strips(slice(row, row + 1)) for row in sample.tolist()]), networks[-1]):
        print(f"{log}: the images seem to have red and blue exchanged: exchange them again (cv2 has BGR)", flush=True)
    return position
