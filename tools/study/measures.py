"""Train a network of the study and measure it: its errors on a recording, its replays, its laps, its recovery."""

import contextlib
import csv
import io
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import model
from cloning.base.errors import UserError
from cloning.base.outputs import write_json
from cloning.network.network import Network, steer
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording
from cloning.recordings.writer import SampleClock
from cloning.replay.command import drive_at_limits
from cloning.replay.drift import drifts, held_out
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import load_recording, reference_lines
from cloning.road.autonomy import LIMITS
from cloning.road.motion import MPH
from cloning.road.track import Track
from simulator.cameras import Cameras
from simulator.run import Run
from simulator.world import Scene
from tools.study.networks import RENDERED, TRACKS, Variant

LARGE_ERROR = 0.2  # of steering: the "thresholded relative error" of Codevilla et al. (1809.04843) has another unit
TIME_OUT = 1.5  # times the time of a lap at the set speed; a car that leaves the road over and over gets no further
RECOVERY_SPEED, RECOVERY_SECONDS = 20.0, 3.0  # mph; the time is ChauffeurNet's (1812.03079)
RECOVERY_OFFSETS, RECOVERY_TURNS = (0.5, 2.0), (2.0, 20.0)  # m from the lane's centre, degrees to its direction
RECOVERED = 0.5, 5.0  # m and degrees: nearer than both is back in the lane
FRAMES_PER_BATCH = 32


def measure(variant: Variant, recordings: Path, file: Path, epoch_images: int, share: float, starts: int) -> None:
    """Train a network, continuing if it was begun, and write its measures as JSON.

    recordings: the folder of the real recordings; file: in the network's own folder, beside that of the rendered
    recording; epoch_images: number of images in an epoch; share: of a lap to drive; starts: number of those from which
    it is to recover. Call it in a process of its own, which it sets up for training. Raises UserError, OSError.
    """
    folder, track = file.parent, TRACKS[variant.track]
    folder.mkdir(parents=True, exist_ok=True)
    sources = [(folder.parent if name == RENDERED else recordings) / name for name in variant.recordings]
    recipe = replace(variant.recipe, samples_per_epoch=epoch_images)
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        status = model.train(recipe, sources, folder / "model.pt", variant.seed, device="cpu", resume=True)
    if status:
        raise UserError(f"{folder}: status {status}: {errors.getvalue().strip()[-500:]}")
    torch.set_num_threads(1)
    driver, held_out_recording = ModelDriver(str(folder / "model.pt")), load_recording(recordings / track.held_out)
    with open(folder / "training_log.csv", encoding="utf-8", newline="") as log:
        *_, last = csv.DictReader(log)
    found = {"own_val_loss": float(last["val_loss"])}
    found |= offline(driver.network, held_out_recording) | replayed(held_out_recording, driver)
    simulators = [Simulator(driver.network, variant.track, direction, track.speed) for direction in track.directions]
    found |= laps(simulators, share)
    if variant.recovers:
        found["recovered"] = simulators[0].recovery(starts)
    write_json(file, {name: round(value, 6) for name, value in found.items()})
    print(f"{variant.name} is measured", flush=True)


def offline(network: Network, recording: Recording) -> dict[str, float]:
    """Return a network's errors at the recorded poses, with the human driver's steering as label.

    whiteness: root mean square of the steering's change per second (University of Tartu's measure), here of the
    steering on the recorded frames. Raises RecordingError.
    """
    paths, parts = [recording.path(row) for row in range(len(recording))], []
    for start in range(0, len(paths), FRAMES_PER_BATCH):
        frames = np.stack([read_frame(path) for path in paths[start : start + FRAMES_PER_BATCH]])
        with torch.inference_mode():
            parts.append(network(torch.from_numpy(frames)).numpy())
    guess = np.concatenate(parts).clip(-1, 1)
    error = guess - recording.steering
    seconds = np.diff(recording.time)
    change = np.diff(guess)[seconds > 0] / seconds[seconds > 0]
    return {
        "mse": float(np.mean(error**2)),
        "mae": float(np.abs(error).mean()),
        "correlation": float(np.corrcoef(guess, recording.steering)[0, 1]) if np.ptp(guess) else 0.0,
        "large_errors": float((np.abs(error) > LARGE_ERROR).mean()),
        "whiteness": float(np.sqrt(np.mean(change**2))),
    }


def replayed(recording: Recording, driver: ModelDriver) -> dict[str, float]:
    """Return what replays of a recording measure: NVIDIA's autonomy at both limits, distances, and drift."""
    found: dict[str, float] = {}
    for done in drive_at_limits(recording, reference_lines(recording), driver, LIMITS, parallel=True):
        limit = done.limit
        metres = float(np.sum(recording.speed[done.row] * MPH * done.seconds))
        found[f"autonomy_{limit:g}"] = done.autonomy()
        found[f"replay_distance_{limit:g}"] = float(np.abs(done.offset).mean())
        found[f"metres_per_intervention_{limit:g}"] = metres / max(1, len(done.interventions))
    n = len(recording)
    every = held_out([recording], np.zeros(n, int), np.arange(n), np.zeros(n))
    with ThreadPoolExecutor(1) as pool:
        found["drift"] = float(drifts(every, driver.network, pool).mean())
    return found


class Simulator:
    """The stand-in simulator's car with its centre camera, steered by a network in this process."""

    def __init__(self, network: Network, track: str, direction: str, speed: float):
        """speed: set speed, mph, which the car holds where the road allows it."""
        self.network, self.track, self.speed = network, Track(track, direction), speed
        self.cameras = Cameras(Scene.of(track), ("center",))

    def start(self) -> Run:
        """Return a new run, whose car stands on the road."""
        run = Run(self.track, "autonomous")
        run.car.speed_limit = self.speed * MPH
        return run

    def steering(self, run: Run) -> float:
        """Return the network's steering for what the car sees now."""
        return float(steer(self.network, self.cameras.frames(run.car.node.get_transform())[0]))

    def lap(self, laps: float) -> Run:
        """Drive on after departures, to the laps' end or TIME_OUT, and return the run."""
        run, clock = self.start(), SampleClock(1 / SAMPLE_RATE)
        metres = laps * self.track.length
        steering = self.steering(run)
        while run.travelled < metres and run.time < TIME_OUT * metres / (self.speed * MPH):
            run.step(steering, 1.0)
            if clock.due(run.time):
                steering = self.steering(run)
        return run

    def recovery(self, starts: int) -> float:
        """Return the share of starts next to the lane's centre, and turned, from which the car comes back in time.

        The starts are the same for every network: all around the track, offsets and turns to all sides.
        """
        rng = np.random.default_rng(0)
        sides = np.where(rng.random((starts, 2)) < 0.5, -1, 1)
        offsets = sides[:, 0] * rng.uniform(*RECOVERY_OFFSETS, starts)
        turns = sides[:, 1] * np.radians(rng.uniform(*RECOVERY_TURNS, starts))
        along = (np.arange(starts) + rng.random(starts)) / starts * self.track.length
        run = self.start()
        return float(np.mean([self.comes_back(run, *start) for start in zip(along, offsets, turns, strict=True)]))

    def comes_back(self, run: Run, s: float, offset: float, turn: float) -> bool:
        """Return whether the car is back in the lane in time, without leaving the road before.

        s: m along the track; offset: m, right positive; turn: radians to the right.
        """
        run.s, until = s, run.time + RECOVERY_SECONDS
        run.set_back(offset, RECOVERY_SPEED * MPH, turn)
        clock, steering = SampleClock(run.time + 1 / SAMPLE_RATE), self.steering(run)
        while run.time < until:
            if not run.advance(steering, 1.0):
                return False
            offset, heading_error = run.lane
            if abs(offset) < RECOVERED[0] and math.degrees(abs(heading_error)) < RECOVERED[1]:
                return True
            if clock.due(run.time):
                steering = self.steering(run)
        return False


def laps(simulators: Sequence[Simulator], share: float) -> dict[str, float]:
    """Return the measures of a network's laps, one in each simulator, together; share: of a lap, such as 1."""
    runs = [simulator.lap(share) for simulator in simulators]
    return {
        "departures_per_km": sum(len(run.departures) for run in runs) / sum(run.distance for run in runs) * 1000,
        "offset_mean": float(np.mean([np.abs(run.trajectory.offset).mean() for run in runs])),  # m
    }
