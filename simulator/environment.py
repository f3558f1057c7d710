"""The stand-in simulator as a Gymnasium environment; importing this module registers it.

    import gymnasium, numpy, torch
    from cloning.network.network import SHIPPED_MODEL, load_model, steer

    env = gymnasium.make("simulator.environment:behavioral-cloning/Drive-v0", track="lake", speed=15)
    network = load_model(SHIPPED_MODEL)
    torch.set_num_threads(1)  # for a single frame, several threads mostly wait for one another
    frame, info = env.reset()
    terminated = truncated = False
    while not (terminated or truncated):
        action = numpy.array([steer(network, frame), 1.0], numpy.float32)
        frame, reward, terminated, truncated, info = env.step(action)
    print("left the road" if terminated else "drove a lap", info)

`gymnasium.make_vec(simulator.environment.ID, num_envs=2, vectorization_mode="async")` runs several environments, each
in a process of its own. Several in one process do not disturb one another either, but share one core. Nearly all of a
step's time goes into rendering the frame in software, on one core.
"""

import math
import operator
from collections.abc import Callable
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from gymnasium.utils import EzPickle

from cloning.base.errors import SimulatorError
from cloning.base.frame import FRAME
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.writer import SampleClock
from cloning.road.disturbances import Disturbance
from cloning.road.generated import PointRoad
from cloning.road.motion import MPH, TOP_SPEED_MPH
from cloning.road.track import Track
from simulator.cameras import Cameras
from simulator.film import ChaseView
from simulator.run import Run
from simulator.world import Scene, free_unused

ID = "behavioral-cloning/Drive-v0"
MAX_STEPS = 10 * 60 * SAMPLE_RATE  # ten simulated minutes, so that the episode of a car that stands still ends, too
Info = dict[str, Any]  # about a step: see `Drive`
OPTIONS = ("s", "offset", "turn", "track", "direction", "look", "disturb")  # of reset
DEPARTURE_PENALTY = 100.0  # m of progress; Gymnasium's CarRacing gives the same for leaving its playfield
# As in a training: what a seed gives to a whole drive, such as drops on the lens, stays in memory.
DISTURBANCE_SEEDS = 32


def check(name: str, value: Any, valid: Callable[[Any], bool], allowed: str) -> None:
    """Raise SimulatorError if a value is not valid, or of a type that cannot be compared; allowed: what is valid."""
    try:
        accepted = np.ndim(value) == 0 and valid(value)
    except (TypeError, ValueError, ArithmeticError):
        accepted = False
    if not accepted:
        raise SimulatorError(f"{name} {value!r}: it must be {allowed}")


def number_of_look(look: Any) -> int:
    """Return the number that an argument or option gives for a look. Raises SimulatorError."""
    check("look", look, lambda number: operator.index(number) >= 0, "a whole number from 0, as an int")
    return operator.index(look)  # NumPy's may be too small for what is calculated from it


def parse_disturbance(text: Any) -> Disturbance | None:
    """Return the disturbance that an argument or option names. Raises SimulatorError."""
    try:
        return None if text is None else Disturbance.parse(str(text))
    except ValueError as error:
        raise SimulatorError(f"disturb: {error}") from None


def make_track(track: Any, direction: Any) -> Track:
    """Return the track that an argument or option names. Raises TrackError, or SimulatorError for other types."""
    named = "a name, such as 'lake', 'jungle' or 'road-1', or a road of cloning.road.points"
    check("track", track, lambda source: isinstance(source, str | PointRoad), named)
    check("direction", direction, lambda name: name in ("ccw", "cw", None), "'ccw', 'cw' or None")
    return Track(track, direction)


def set_on_road(run: Run, options: dict[str, Any]) -> None:
    """Set the car on its road; options: see `Drive.reset`. Raises SimulatorError."""
    turn = options.get("turn", 0.0)
    check("turn", turn, lambda radians: -math.pi <= radians <= math.pi, "-π to π (radians)")
    s, offset = options.get("s", run.s), options.get("offset", 0.0)
    length = run.track.length
    check("s", s, lambda metres: 0 <= metres < length, f"at least 0 and less than {length:.1f} (m)")
    left, right = run.track.edges[run.track.index(s)]
    edges = f"at {s:.1f} m the edges are at {-left:.2f} and {right:.2f} m"
    check("offset", offset, lambda metres: -left <= metres <= right, f"a number on the road (m); {edges}")
    run.s = float(s)
    run.set_back(float(offset), turn=float(turn))
    if side := run.off_road():
        raise SimulatorError(f"offset {offset!r}: a wheel would be beyond the road's {side} edge; {edges}")


class Drive(gymnasium.Env[np.ndarray, np.ndarray], EzPickle):
    """Drive the simulator's car by its centre camera; a step lasts one frame, 1/15 s of simulated time.

    | | |
    |---|---|
    | observation | the centre camera's frame: uint8 (160, 320, 3), RGB |
    | action | steering and throttle: float32 (2,), each -1..1 (values beyond are clipped); right is positive; a negative throttle brakes, or reverses below 5 mph |
    | reward | m of progress along the centre line in this step, less 100 if the car left the road |
    | terminated | the car left the road with a wheel (kerbs belong to the road); `reset` starts again |
    | truncated | the laps are finished, or, by Gymnasium's own wrapper, after `max_episode_steps` (default 9000) |
    | info | `s`: m along the track; `offset`: lateral offset in m, right positive; `speed`: mph; `departures`: 0 or 1; `laps`: finished laps |
    | info, in gym-donkeycar's names | `cte`: as offset; `pos`: m east, up and north, as in Unity; `hit`: "none", or the side on which the car left the road; `lap_count`: as laps; `last_lap_time`: s, 0 before the first |

    The same seed, options and actions give the same frames, bit for bit. A pickled environment becomes one with the
    same arguments that waits for `reset`.
    """  # noqa: E501 - lines of a table

    metadata = {"render_modes": ["rgb_array"], "render_fps": SAMPLE_RATE}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(
        self,
        track: str | PointRoad = "lake",
        direction: str | None = None,
        look: int = 0,
        speed: float = TOP_SPEED_MPH,
        laps: float = 1,
        random_start: bool = False,
        render_mode: str | None = None,
        disturb: str | None = None,
    ):
        """Build the track's scene. Raises TrackError for an unknown track, SimulatorError for other arguments.

        track: "lake", "jungle", "road-1", "road-2", …, or a road of cloning.road.points;
        direction: "ccw", "cw" or None for that of the real simulator, or in which the road's points are listed;
        look: 0 like the real simulator, any greater number in other light, colours, textures and plants; speed: set
        speed in mph, 1 to 30, which the car never exceeds; laps: after which an episode is truncated, such as 0.5;
        random_start: begin each episode anywhere on the centre line instead of where the autonomous mode does;
        render_mode: "rgb_array" (a view from behind the car) or None; disturb: foul weather or a fault of the camera,
        such as "fog:3" (see cloning.road.disturbances), in each episode by one of 32 seeds, or None.
        """
        EzPickle.__init__(self, track, direction, look, speed, laps, random_start, render_mode, disturb)
        self.track = make_track(track, direction)
        look = number_of_look(look)
        check("speed", speed, lambda mph: 1 <= mph <= TOP_SPEED_MPH, f"1 to {TOP_SPEED_MPH} (mph)")
        check("laps", laps, lambda number: 0 < number < math.inf, "a number above 0")
        check("random_start", random_start, lambda value: isinstance(value, bool), "True or False")
        check("render_mode", render_mode, lambda mode: mode in ("rgb_array", None), "'rgb_array' or None")
        self.disturbance = parse_disturbance(disturb)
        self.observation_space = spaces.Box(0, 255, FRAME, np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.look, self.speed, self.laps, self.random_start = look, speed, laps, random_start
        scene = Scene.of(track, look)
        self.cameras = Cameras(scene, ("center",))
        self.render_mode, self.view = render_mode, ChaseView(scene) if render_mode else None
        self.state: Literal["new", "driving", "ended", "closed"] = "new"
        self.finished = False  # whether the episode's laps are driven

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, Info]:
        """Begin an episode, with the car at rest on its springs; return the first frame and info.

        seed: of the random starts. Of the options "s", m along the track, 0 up to its length, "offset", lateral offset
        in m, right positive (default 0), and "turn", radians from the road's direction to the right (default 0), say
        where to start; "track", "direction" and "look", as above, which road to drive from now on, and "disturb" in
        what. Raises TrackError or SimulatorError if there is no such thing, and gymnasium's ClosedEnvironmentError
        after `close`.
        """
        self._check_open()
        super().reset(seed=seed)
        self.state, self.finished = "new", False  # until the car stands on the road
        options = {} if options is None else options
        if not isinstance(options, dict) or options.keys() - set(OPTIONS):
            raise SimulatorError(f"options {options!r}: the options of reset are {', '.join(OPTIONS)}, in a dict")
        disturbance = parse_disturbance(options["disturb"]) if "disturb" in options else self.disturbance
        track, look = self._chosen_road(options)
        run = Run(track, "autonomous")
        run.car.speed_limit = self.speed * MPH
        if self.random_start:
            run.s = self.np_random.uniform(0, track.length)
        set_on_road(run, options)
        if (track.source, look) != (self.track.source, self.look):
            scene = Scene.of(track.source, look)
            self.cameras.move(scene)
            if self.view:
                self.view.move(scene)
        self.run, self.track, self.look = run, track, look
        self.clock = SampleClock(1 / SAMPLE_RATE)
        self.disturbance = disturbance
        self.cameras.disturb(disturbance, int(self.np_random.integers(DISTURBANCE_SEEDS)) if disturbance else 0)
        self.state = "driving"
        return self._frame(), self._info()

    def _check_open(self) -> None:
        if self.state == "closed":
            raise ClosedEnvironmentError("the environment is closed: make another one")

    def _chosen_road(self, options: dict[str, Any]) -> tuple[Track, int]:
        """Return the road and look that the options name, or the present ones. Raises SimulatorError, TrackError."""
        if not options.keys() & {"track", "direction", "look"}:
            return self.track, self.look
        source, look = options.get("track", self.track.source), options.get("look", self.look)
        track = make_track(source, options.get("direction", None if "track" in options else self.track.direction))
        return track, number_of_look(look)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """Drive until the next frame is due, or the car leaves the road; return what the class describes.

        Raises gymnasium's InvalidAction for an action that is not two finite numbers, its ResetNeeded before the first
        `reset` and after the end of an episode, and its ClosedEnvironmentError after `close`.
        """
        self._check_open()
        if self.state != "driving":
            raise ResetNeeded("call reset() before the first step and after the end of an episode")
        try:
            commands = np.asarray(action, float)
        except (TypeError, ValueError):
            commands = np.empty(0)
        if commands.shape != (2,) or not np.isfinite(commands).all():
            raise InvalidAction(f"{action!r}: an action is two finite numbers, steering and throttle")
        steering, throttle = np.clip(commands, -1, 1).tolist()
        run = self.run
        before = run.laps * self.track.length if run.at_end else run.travelled  # another lap begins at rest
        stayed = run.advance(steering, throttle)
        while stayed and not (run.at_end or self.clock.due(run.time)):
            stayed = run.advance(steering, throttle)
        reward = float(run.travelled - before) - (0 if stayed else DEPARTURE_PENALTY)
        self.finished = bool(run.travelled >= self.laps * self.track.length or run.laps >= self.laps)
        self.state = "ended" if self.finished or not stayed else "driving"
        return self._frame(), reward, not stayed, self.finished, self._info()

    def _frame(self) -> np.ndarray:
        """Render the centre camera's present frame: uint8 (160, 320, 3), RGB."""
        return self.cameras.frames(self.run.car.node.get_transform())[0]

    def _info(self) -> Info:
        """Return the present state; see the class."""
        run = self.run
        east, north, up = run.car.node.get_pos()
        lap_times = [0.0, *run.lap_times]
        return {
            "s": float(run.s),
            "offset": run.offset,
            "speed": run.speed_mph,
            "departures": len(run.departures),
            "laps": run.laps,
            "cte": run.offset,
            "pos": (east, up, north),
            "hit": run.departures[-1].side if run.departures else "none",
            "lap_count": run.laps,
            "last_lap_time": lap_times[-1] - lap_times[-2] if run.laps else 0.0,
        }

    def render(self) -> np.ndarray | None:
        """Render the view from behind the car: uint8 (360, 640, 3), RGB; None without a render mode.

        Raises gymnasium's ResetNeeded before the first `reset`, and its ClosedEnvironmentError after `close`.
        """
        self._check_open()
        if self.state == "new":
            raise ResetNeeded("call reset() before render()")
        return self.view.frame(self.run) if self.view else None

    def close(self) -> None:
        """Free the scene and the rendered images; after this only `close` may be called again."""
        if self.state != "closed":
            self.state = "closed"
            del self.cameras, self.view
            free_unused()


gymnasium.register(ID, entry_point=f"{__name__}:{Drive.__name__}", max_episode_steps=MAX_STEPS)
