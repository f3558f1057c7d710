"""Foretells, from the frames alone, that a network will leave the road: it says when it is out of its depth.

Signs of that are what the lane reader sees (how far off the lane's centre the car is, and whether a frame and its
mirror image tell it the same), steering that does not fit it or changes quickly, and activations of either network that
are unlike those of ordinary driving (their Mahalanobis distance, arXiv 1807.03888). From the signs' means over a short
and a longer time, a regression tells how far off the lane's centre the car will be; the farther, the greater the risk.
A single sign tells, too, where it is greater than in nearly all driving that stays on the road. The figures are in a
file beside the network's, which `python -m tools.foretell` writes and measures; they fit this one network. One more
sign needs no figures: a camera that shows nothing new while the car drives.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import nn

from cloning.base.errors import ModelError
from cloning.base.outputs import as_typed
from cloning.lane.reader import ANY_ROAD_WEIGHTS, DISTANCES_AHEAD, extract_strip, fold_norms, load_network, normalize
from cloning.lane.recovery import LOOKAHEAD
from cloning.network import tensors
from cloning.network.network import Network, steer

ENDING = ".limits.pt"  # of the file beside a network's, and its arrays
ARRAYS = ("weights", "extreme", "steering", "activations", "activations_factor", "hidden", "hidden_factor")
MOST_UNITS = 100  # of the driving network's layer whose activations are compared
MEAN_TIMES = np.array([0.3, 1.5], np.float32)  # s, of the signs' exponential means
MAX_STEP = 1.0  # s: a longer pause counts as this
BLIND_STEP = 0.2  # s, likewise in `Blindness`: at 30 mph, one frame that is like the last before a pause is no alarm
LEAST = 0.01  # added to a sign before its logarithm is taken
ALARM = 0.5  # the risk from which it is an alarm: the file's figures are shifted so
STEEPNESS = 4.0  # log odds for a distance, or an extreme sign, e times as great
EARLIEST, LATEST = 6.0, 1.0  # s before a departure: an alarm in between foretells it
WINDOW = EARLIEST - LATEST  # s of a drive without a departure, in which false alarms count once


class Observation(NamedTuple):
    """What the networks make of a frame; in the tool each array has one more dimension, for the frames of a drive."""

    steering: np.ndarray  # float32 (): -1..1
    # float32 (u,): inputs of the driving network's first dense layer of MOST_UNITS or fewer, or its last one.
    activations: np.ndarray
    hidden: np.ndarray  # float32 (96,): of the lane network
    centres: np.ndarray  # float32 (5,): m to the lane's centre at DISTANCES_AHEAD, right positive
    mirrored: np.ndarray  # float32 (5,): the same in the mirror image


class Observer:
    """Computes the steering and what else the foretelling needs of a frame."""

    def __init__(self, network: Network):
        """Watch a network's activations from now on."""
        self.network, self.lane = network, fold_norms(load_network(ANY_ROAD_WEIGHTS))
        self.activations = torch.empty(0)
        dense = [layer for layer in network.dense if isinstance(layer, nn.Linear)]
        watched = next((layer for layer in dense if layer.in_features <= MOST_UNITS), dense[-1])
        watched.register_forward_pre_hook(self._keep)

    def _keep(self, layer: nn.Module, inputs: tuple[torch.Tensor, ...]) -> None:
        self.activations = inputs[0]

    def __call__(self, frame: np.ndarray) -> Observation:
        """Return what a frame, uint8 (160, 320, 3) RGB, shows; raises ArithmeticError as `steer`."""
        steering = steer(self.network, frame)
        activations = self.activations[0].float().cpu().numpy().copy()
        strip = torch.from_numpy(normalize(extract_strip(frame)))
        with torch.inference_mode():
            pixels = torch.stack([strip, strip.flip(1)]).permute(0, 3, 1, 2)
            hidden = self.lane.dense[:2](self.lane.convolutions(pixels).flatten(1))
            centres = self.lane.dense[2](hidden).numpy()
        return Observation(np.asarray(steering), activations, hidden[0].numpy(), *centres)


class Normal(NamedTuple):
    """A normal distribution of activations: mean (n,) and factor (n, n), which turns them into independent ones."""

    mean: np.ndarray
    factor: np.ndarray

    @classmethod
    def of(cls, values: np.ndarray) -> Self:
        """Fit values (rows, n)."""
        mean, covariance = values.mean(0), np.cov(values.T)
        covariance += np.eye(len(mean)) * 1e-3 * np.trace(covariance) / len(mean)  # so that it has an inverse
        factor = np.linalg.cholesky(np.linalg.inv(covariance))
        return cls(mean.astype(np.float32), factor.astype(np.float32))

    def distance(self, values: np.ndarray) -> np.floating:
        """Return the Mahalanobis distance of values (n,), about 1 for those of the distribution."""
        return np.sqrt(np.mean(((values - self.mean) @ self.factor) ** 2))


class Ordinary(NamedTuple):
    """What is ordinary for a network."""

    steering: np.ndarray  # float32 (5,): the steering is about this, times the lane's centre at DISTANCES_AHEAD
    activations: Normal  # those of the driving network
    hidden: Normal  # those of the lane network

    @classmethod
    def of(cls, observed: Observation) -> Self:
        """Fit the observations of ordinary driving, (rows, …)."""
        centres = (observed.centres - observed.mirrored) / 2
        steering = np.linalg.lstsq(centres, observed.steering, rcond=None)[0]
        return cls(steering.astype(np.float32), Normal.of(observed.activations), Normal.of(observed.hidden))


class Signs:
    """The signs of one drive, whose observations it is given one after the other."""

    def __init__(self, ordinary: Ordinary):
        self.ordinary, self.time = ordinary, 0.0
        self.usual = self.means = np.empty(0, np.float32)  # before the first

    def __call__(self, observed: Observation, time: float) -> np.ndarray:
        """Return the signs' means over MEAN_TIMES, one after the other, float32 (2 k,); time: s."""
        kept = np.exp(-np.clip(time - self.time, 0, MAX_STEP) / MEAN_TIMES)
        centres = (observed.centres - observed.mirrored) / 2
        now = np.append(centres, observed.steering)
        if not len(self.usual):
            self.usual = now
        self.usual = now + kept[0] * (self.usual - now)
        unlike_mirrored, changed = np.abs(observed.centres + observed.mirrored), np.abs(now - self.usual)
        unusual = [
            abs(observed.steering - centres @ self.ordinary.steering),
            self.ordinary.activations.distance(observed.activations),
            self.ordinary.hidden.distance(observed.hidden),
        ]
        signs = np.log(np.concatenate([np.abs(now), unlike_mirrored, changed, unusual]) + LEAST)
        if not len(self.means):
            self.means = np.tile(signs, (len(MEAN_TIMES), 1))
        self.means, self.time = signs + kept[:, None] * (self.means - signs), time
        return self.means.ravel().astype(np.float32)


class Blindness:
    """How far the car of one drive has come since its camera showed anything new."""

    def __init__(self) -> None:
        self.frame, self.time, self.metres = np.empty(0, np.uint8), 0.0, 0.0

    def __call__(self, frame: np.ndarray, time: float, speed: float) -> float:
        """Return it in m, after the next frame; time: s, speed: m/s."""
        passed, self.time = min(max(time - self.time, 0.0), BLIND_STEP), time
        self.metres = self.metres + speed * passed if np.array_equal(frame, self.frame) else 0.0
        self.frame = frame
        return self.metres


class Limits(NamedTuple):
    """What tells when a network is out of its depth."""

    ordinary: Ordinary
    weights: np.ndarray  # float32 (2 k,), of the signs' means
    extreme: np.ndarray  # float32 (k,): the signs' means over the shorter time from which one alone is an alarm
    bias: float  # so that the risk is ALARM where an alarm is due
    stop: float  # the risk at which a car is better stopped

    def risk(self, signs: np.ndarray, blind: float | np.ndarray) -> Any:
        """Return the risk, 0..1, for signs (…, 2 k) and blindness (…), m.

        After LOOKAHEAD without a new frame the car is where the last one steered it, and nothing tells what comes.
        """
        odds = np.maximum(signs @ self.weights + self.bias, odds_of_one(signs, self.extreme))
        risk = 1 / (1 + np.exp(-np.clip(odds, -30, 30)))
        return np.maximum(risk, np.minimum(np.divide(blind, LOOKAHEAD), 1))


def odds_of_one(signs: np.ndarray, extreme: np.ndarray) -> Any:
    """Return the log odds that the most extreme of the signs (…, 2 k) tells alone; extreme: see `Limits`."""
    return STEEPNESS * (signs[..., : len(extreme)] - extreme).max(-1)


class Foreteller:
    """Steers in one drive, and says at each frame how likely it is that the car will leave the road."""

    def __init__(self, observer: Observer, limits: Limits):
        self.observer, self.limits, self.signs, self.blindness = observer, limits, Signs(limits.ordinary), Blindness()

    def __call__(self, frame: np.ndarray, time: float, speed: float) -> tuple[np.float32, float]:
        """Return the steering and the risk, 0..1, for a drive's next frame, uint8 (160, 320, 3) RGB.

        time: s; speed: m/s.
        """
        observed, blind = self.observer(frame), self.blindness(frame, time, speed)
        return np.float32(observed.steering), float(self.limits.risk(self.signs(observed, time), blind))


# ----------------------------------------------------------------------------------------------------------------------
# The file


def limits_file(model: Path) -> Path:
    """Return the file beside a network's: model.limits.pt for model.pt."""
    return model.with_suffix(ENDING)


def fingerprint(network: Network) -> str:
    """Return what binds limits to a network, and to the lane network."""
    return tensors.compute_digest([network.state_dict(), load_network(ANY_ROAD_WEIGHTS).state_dict()])


def save_limits(model: Path, network: Network, limits: Limits) -> None:
    """Write the limits beside the file of their network. Raises OSError."""
    steering, activations, hidden = limits.ordinary
    numbers = dict(zip(ARRAYS, (limits.weights, limits.extreme, steering, *activations, *hidden), strict=True))
    arrays = {name: torch.from_numpy(np.asarray(value, np.float32)) for name, value in numbers.items()}
    about = {"fingerprint": fingerprint(network), "bias": limits.bias, "stop": limits.stop}
    tensors.save(limits_file(model), {**about, "arrays": arrays})


def load_limits(model: Path, network: Network) -> Limits | None:
    """Return the limits beside a network's file; None without such a file, or if it is another network's.

    Raises ModelError for a file that is damaged.
    """
    path, command = limits_file(model), as_typed("python", "-m", "tools.foretell", model)
    remedy = f"delete it, or measure the network again: `{command}`"
    if not path.exists():
        return None
    saved = tensors.load(path, remedy)
    if saved.get("fingerprint") != fingerprint(network):
        return None
    try:
        return _read(saved)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: not what tells a network's limits ({error}); {remedy}") from None


def _read(saved: Mapping[str, Any]) -> Limits:
    """Return the limits of a file's contents. Raises KeyError, TypeError, ValueError."""
    found = saved["arrays"]
    units, hidden, distances = len(found["activations"]), len(found["hidden"]), len(DISTANCES_AHEAD)
    signs = 3 * distances + 5
    shapes = (len(MEAN_TIMES) * signs,), (signs,), (distances,), (units,), (units, units), (hidden,), (hidden, hidden)
    arrays = tensors.matching(found, dict(zip(ARRAYS, map(torch.empty, shapes), strict=True)))
    if not all(tensors.is_number(saved[name]) for name in ("bias", "stop")):
        raise ValueError("bias and stop are no numbers")
    weights, extreme, steering, *normals = (arrays[name].numpy() for name in ARRAYS)
    ordinary = Ordinary(steering, Normal(*normals[:2]), Normal(*normals[2:]))
    return Limits(ordinary, weights, extreme, float(saved["bias"]), float(saved["stop"]))
