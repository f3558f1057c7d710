"""Render frames from known poses, by which the lane network is trained and measured.

The tracks are rendered in many looks, with and without shadows, and so are generated roads, so that neither the light
nor the road is one that the network knows. Roads below FIRST_ROAD and looks from 101 on are left to measure with.
"""

import functools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from panda3d.core import Point3, TransformState, Vec3

from cloning.lane.ahead import centre_ahead
from cloning.lane.reader import DISTANCES_AHEAD, STRIP_SHAPE, extract_strip
from cloning.network.compute import threads
from cloning.recordings.images import decode
from cloning.road.motion import CAMERA_FORWARD
from cloning.road.track import Track
from simulator.cameras import Cameras, jpeg
from simulator.scenery.looks import SHADOWED
from simulator.workers import results, started_workers
from simulator.world import Scene

FRAME_SHARES = {"lake": 1, "jungle": 2}  # relative: hills and narrow bends are harder
FIRST_ROAD = 1001  # the first generated road that networks are trained on
LOOKS = 101  # in which generated roads are rendered, from 0 on
MAX_OFFSET, MAX_YAW = 3.5, 15.0  # m and degrees: lateral offset and heading error


class RenderedScene(NamedTuple):
    """A track in a look, and how many frames to render of it."""

    track: str
    look: int
    frames: int


def shadowed(look: int) -> int:
    """Return a look's twin with shadows: every second one with the dark kind."""
    return look + SHADOWED * (1 + look % 2)


def every_second_shadowed(look: int) -> int:
    """Return the look or its shadowed twin, two of four in a row, so that both directions have looks of either kind."""
    return shadowed(look) if look % 4 < 2 else look


def scenes(looks: int, number_of: dict[str, int], frames: int) -> list[RenderedScene]:
    """Return what the lane network is trained on: both tracks in so many looks, and generated roads.

    Each look of a track comes without and with shadows; every second road has shadows. number_of: generated roads of
    each kind, in LOOKS looks; frames: of a scene, times the track's share. Look 0, which resembles the real simulator,
    gets three times as many.
    """
    tracks = [
        RenderedScene(track, twin, frames * share * (1 if look else 3))
        for look in range(looks)
        for track, share in FRAME_SHARES.items()
        for twin in (look, shadowed(look))
    ]
    return tracks + [
        RenderedScene(f"{kind}-{FIRST_ROAD + k}", every_second_shadowed(k % LOOKS), frames)
        for kind, roads in number_of.items()
        for k in range(roads)
    ]


def render_strips(scene: RenderedScene, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Render strips from random poses, and return them with the true positions of the lane's centre.

    The car is off the lane's centre, turned, and pitches and rolls as on its springs, in both directions of the track.
    Strips: uint8 (n, 32, 160, 3); centres: float32 (n, 5), m to the right of the camera, nan where it is out of sight.
    """
    name, look, frames = scene
    rng = np.random.default_rng([seed, look, *name.encode()])
    cameras = Cameras(Scene.of(name, look), ("center",))
    tracks = [Track(name, direction) for direction in ("ccw", "cw")]
    strips, centres = np.empty((frames, *STRIP_SHAPE), np.uint8), np.empty((frames, len(DISTANCES_AHEAD)), np.float32)
    positions = np.sort(rng.uniform(0, tracks[0].length, frames))  # sorted, because haze is computed again every 25 m
    for k, position in enumerate(positions):
        direction = rng.integers(2)
        track, s = tracks[direction], (position, tracks[0].length - position)[direction]
        right = rng.uniform(-MAX_OFFSET, MAX_OFFSET)
        large = rng.random() < 0.3
        yaw = rng.uniform(-MAX_YAW, MAX_YAW) if large else np.clip(rng.normal(0, MAX_YAW / 3), -MAX_YAW, MAX_YAW)
        pose = track.at(s, right)
        heading = pose.heading - np.radians(yaw)
        pitch = np.degrees(np.arctan(pose.grade)) + rng.normal(0.1, 0.5)
        angles = Vec3(np.degrees(heading) - 90, pitch, rng.normal(0, 0.6))
        middle = Point3(pose.x, pose.y, pose.z + rng.normal(0.025, 0.03))
        frame = cameras.frames(TransformState.make_pos_hpr(middle, angles))[0]
        strips[k] = extract_strip(decode(jpeg(frame)))
        along = np.array([np.cos(heading), np.sin(heading)])
        centres[k] = centre_ahead(track, s, np.array([pose.x, pose.y]) + CAMERA_FORWARD * along, heading)
    return strips, centres


def render_all(chosen: Iterable[RenderedScene], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Run `render_strips` for several scenes, in several processes, and return all frames. Raises SimulatorError."""
    with started_workers(threads()) as pool:
        strips, centres = zip(*results(pool, functools.partial(render_strips, seed=seed), chosen), strict=True)
    return np.concatenate(strips), np.concatenate(centres)
