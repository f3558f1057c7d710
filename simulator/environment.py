"""The stand-in simulator as a Gymnasium environment; importing this module registers it.

    import gymnasium, numpy, simulator.environment, torch
    from cloning.network.network import SHIPPED_MODEL, load_model, steer

    env = gymnasium.make("behavioral-cloning/Drive-v0", track="lake", speed=15)
    network = load_model(SHIPPED_MODEL)
    torch.set_num_threads(1)  # for a single frame, several threads mostly wait for one another
    frame, info = env.reset()
    terminated = truncated = False
    while not (terminated or truncated):
        action = numpy.float32([steer(network, frame), 1.0])
        frame, reward, terminated, truncated, info = env.step(action)
    print("left the road" if terminated else "drove a lap", info)

`gymnasium.make_vec(simulator.environment.ID, num_envs=2, vectorization_mode="async")` runs several environments, each
in a process of its own. Several in one process do not disturb one another either, but share one core. Nearly all of a
step's time goes into rendering the frame in software, on one core.
"""

import math
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from cloning.base.errors import SimulatorError
from cloning.base.frame import FRAME
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.writer import SampleClock
from cloning.road.motion import MPH, TOP_SPEED_MPH
from cloning.road.track import Track
from simulator import scenery
from simulator.cameras import Cameras
from simulator.film import ChaseView
from simulator.run import Run
from simulator.world import Scene

ID = "behavioral-cloning/Drive-v0"
MAX_STEPS = 10 * 60 * SAMPLE_RATE  # ten simulated minutes, so that the episode of a car that stands still ends, too
DEPARTURE_PENALTY = 100.0  # m of progress; Gymnasium's CarRacing gives the same for leaving its playfield


class Drive(gymnasium.Env[np.ndarray, np.ndarray]):
    """Drive the simulator's car by its centre camera; a step lasts one frame, 1/15 s of simulated time.

    | | |
    |---|---|
    | observation | the centre camera's frame: uint8 (160, 320, 3), RGB |
    | action | steering and throttle: float32 (2,), each -1..1 (values beyond are clipped); right is positive; a negative throttle brakes, or reverses below 5 mph |
    | reward | m of progress along the centre line in this step, less 100 if the car left the road |
    | terminated | the car left the road with a wheel (kerbs belong to the road); `reset` starts again |
    | truncated | the laps are finished, or, by Gymnasium's own wrapper, after `max_episode_steps` (default 9000) |
    | info | `s`: m along the track; `offset`: lateral offset in m, right positive; `speed`: mph; `departures`: 0 or 1; `laps`: finished laps |

    The same seed, options and actions give the same frames, bit for bit.
    """  # noqa: E501 - lines of a table

    metadata = {"render_modes": ["rgb_array"], "render_fps": SAMPLE_RATE}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(
        self,
        track: str = "lake",
        direction: str | None = None,
        look: int = 0,
        speed: float = TOP_SPEED_MPH,
        laps: float = 1,
        random_start: bool = False,
        render_mode: str | None = None,
    ):
        """Build the track's scene. Raises TrackError for an unknown track, SimulatorError for other arguments.

        track: "lake", "jungle", "road-1", "road-2", …; direction: "ccw", "cw" or None for that of the real simulator;
        look: 0 like the real simulator, any greater number in other light, colours, textures and plants; speed: set
        speed in mph, 1 to 30, which the car never exceeds; laps: after which an episode is truncated, such as 0.5;
        random_start: begin each episode at a random place on the centre line instead of where the autonomous mode does;
        render_mode: "rgb_array" (a view from behind the car) or None.
        """
        for name, value, valid, allowed in (
            ("direction", direction, direction in ("ccw", "cw", None), "'ccw', 'cw' or None"),
            ("look", look, look >= 0 and look % 1 == 0, "a whole number from 0"),
            ("speed", speed, 1 <= speed <= TOP_SPEED_MPH, f"1 to {TOP_SPEED_MPH} (mph)"),
            ("laps", laps, 0 < laps < math.inf, "a number above 0"),
            ("render_mode", render_mode, render_mode in (None, "rgb_array"), "'rgb_array' or None"),
        ):
            if not valid:
                raise SimulatorError(f"{name} {value!r}: it must be {allowed}")
        self.observation_space = spaces.Box(0, 255, FRAME, np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.track, self.speed, self.laps, self.random_start = Track(track, direction), speed, laps, random_start
        scene = Scene(scenery.build(track, look))
        self.cameras = Cameras(scene, ("center",))
        self.render_mode, self.view = render_mode, ChaseView(scene) if render_mode else None
        self.ended = True  # until the first reset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode, with the car at rest on its springs; return the first frame and info.

        seed: of the random starts; options: "s", m along the track, 0 up to its length, and "offset", lateral offset in
        m, right positive (default 0), say where to start. Raises SimulatorError if the road is not there.
        """
        super().reset(seed=seed)
        self.ended = True  # until the car stands on the road
        self.run = Run(self.track, "autonomous")
        self.run.car.speed_limit = self.speed * MPH
        if self.random_start:
            self.run.s = self.np_random.uniform(0, self.track.length)
        self._place(**(options or {}))
        self.clock = SampleClock(1 / SAMPLE_RATE)
        self.ended = False
        return self._frame(), self._info()

    def _place(self, s: float | None = None, offset: float = 0.0, **unknown: object) -> None:
        """Place the car on the road; s, offset: see `reset`, None for where it is. Raises SimulatorError."""
        if unknown:
            raise SimulatorError(f"option {', '.join(unknown)}: the options of reset are s and offset")
        if s is not None:
            if not 0 <= s < self.track.length:
                raise SimulatorError(f"s {s!r}: it must be at least 0 and less than {self.track.length:.1f} (m)")
            self.run.s = float(s)
        if not math.isfinite(offset):
            raise SimulatorError(f"offset {offset!r}: it must be a number (m)")
        self.run.set_back(float(offset))
        if side := self.run.off_road():
            left, right = self.track.edges[self.track.index(self.run.s)]
            raise SimulatorError(
                f"offset {offset!r}: a wheel would be beyond the road's {side} edge; "
                f"at {self.run.s:.1f} m the edges are at {-left:.2f} and {right:.2f} m"
            )

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Drive until the next frame is due, or the car leaves the road; return what the class describes.

        Raises gymnasium's InvalidAction for an action that is not two finite numbers, and its ResetNeeded before the
        first `reset` and after the end of an episode.
        """
        if self.ended:
            raise gymnasium.error.ResetNeeded("call reset() before the first step and after the end of an episode")
        commands = np.asarray(action, float)
        if commands.shape != (2,) or not np.isfinite(commands).all():
            raise gymnasium.error.InvalidAction(f"{action!r}: an action is two finite numbers, steering and throttle")
        steering, throttle = np.clip(commands, -1, 1).tolist()
        before = self.run.travelled
        stayed = self.run.advance(steering, throttle)
        while stayed and not self.clock.due(self.run.time):
            stayed = self.run.advance(steering, throttle)
        reward = float(self.run.travelled - before) - (0 if stayed else DEPARTURE_PENALTY)
        finished = bool(self.run.travelled >= self.laps * self.track.length)
        self.ended = finished or not stayed
        return self._frame(), reward, not stayed, finished, self._info()

    def _frame(self) -> np.ndarray:
        """Render the centre camera's present frame: uint8 (160, 320, 3), RGB."""
        return self.cameras.frames(self.run.car.node.get_transform())[0]

    def _info(self) -> dict[str, Any]:
        """Return the present state; see the class."""
        return {
            "s": float(self.run.s),
            "offset": self.run.offset,
            "speed": self.run.speed_mph,
            "departures": len(self.run.departures),
            "laps": self.run.laps,
        }

    def render(self) -> np.ndarray | None:
        """Render the view from behind the car: uint8 (360, 640, 3), RGB; None without a render mode."""
        return self.view.frame(self.run) if self.view else None


gymnasium.register(ID, entry_point=f"{__name__}:{Drive.__name__}", max_episode_steps=MAX_STEPS)
