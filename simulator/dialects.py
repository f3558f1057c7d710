"""The dialects in which other people's programs speak to the simulator, each on the same wire as drive.py's.

measures  telemetry with what the simulator knows besides, as strings (SelfOracle, ThirdEye)
roads     the program sends roads as text, and has the car set back to their start (maxitwo, perturbation-drive,
          MultiSim)
episodes  the program starts episodes on a track, in a weather and a light, and pauses them (udacity-gym)

All three programs are servers; the simulator connects to them. Lateral offsets (`cte`) are in m, right positive;
`pos_x`, `pos_y`, `pos_z` are m east, up and north, as in Unity.
"""

import base64
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from cloning.base import program
from cloning.base.errors import TrackError
from cloning.road.disturbances import Disturbance
from cloning.road.generated import PointRoad
from cloning.road.motion import FULL_LOCK, MPH
from cloning.road.points import make_road, parse_track_string
from cloning.road.track import Track
from cloning.wire.client import USABLE, Driven, event_packet, parse_commands
from simulator import scenery
from simulator.cameras import Cameras, jpeg
from simulator.run import Run
from simulator.scenery.segments import segments
from simulator.scenery.weather import FALLING, in_weather
from simulator.world import Scene

SECTOR = 10.0  # m of road that waypoints and sectors count
AHEAD = 0.3  # s ahead of the car, if it goes straight on: where `next_cte` is measured, as in the real simulator
CRASHED = 1.0  # s after a departure in which `crash` is 1
LOST = 7.0  # m from the centre line at which a car that nobody sets back is set back
DAY = 120.0  # simulated s of a day and its night
DARKEST = 0.35  # brightness at midnight, of that at noon
ROAD_END = "end of the road"  # `hit` there
TRACKS = {"mountain": "road-40"}  # by the program's name; the others are called as here
ROAD_WEATHERS = {"Rain": "rainy", "Snow": "snowy", "Fog": "foggy"}  # by perturbation-drive's name; its skies are sunny


@dataclass(frozen=True)
class Stage:
    """What the sent roads look like, and the track before the first one."""

    source: str | PointRoad  # of the track that lies there at the start, as the next two: see Track, `scenery.build`
    direction: str | None
    look: int
    road: dict[str, Any]  # width, marking and land of the roads that a program sends, as `make_road` takes them
    disturbance: Disturbance | None = None  # of the camera's frames, or None for that of the weather, if there is one


class Dialect(Driven):
    """A track with a car that a program drives; a subclass says in which words.

    run    the present drive
    still  whether simulated time stands still until the program says something else
    ready  whether the program is to get telemetry
    over   whether the program wants no more
    more   s after an answer in which more may come that belongs to it
    apart  whether the program's driver may be in another thread than its answers
    same   whether the last answer is the same as the one before
    """

    more, apart, same = 0.0, False, False

    def __init__(self, stage: Stage):
        self.stage, self.still, self.ready, self.over, self.episodes = stage, False, True, False, 0
        self.weather = "sunny"  # as `in_weather` names it
        self.views: list[Cameras] = []
        self.replies: list[str] = []  # packets to send besides telemetry
        self.open(stage.source, stage.direction)

    def open(self, source: str | PointRoad, direction: str | None = None) -> None:
        """Build a track, and set the car at its start. Raises TrackError."""
        self.track = Track(source, direction)
        self.show()
        self.restart()

    def show(self) -> None:
        """Let the telemetry's images show the track in its weather from now on. Raises TrackError."""
        for i, built in enumerate(self.build(self.track.source)):
            if i < len(self.views):
                self.views[i].move(Scene(built))
            else:
                self.views.append(Cameras(Scene(built), ("center",)))
        self.begin_frames()

    def begin_frames(self) -> None:
        """Let the next frame be drawn anew, as the first of a drive."""
        self.seen = -1.0  # simulated s at the last frame
        self.views[0].disturb(self.stage.disturbance or FALLING.get(self.weather))

    def build(self, source: str | PointRoad) -> list[scenery.Scenery]:
        """Return what the telemetry's images show. Raises TrackError for an unknown weather."""
        return [in_weather(scenery.build(source, self.stage.look), self.weather)]

    def restart(self) -> None:
        """Set the car at the start of its road, at rest."""
        self.run = Run(self.track, "autonomous")
        self.begin_frames()
        self.steering = self.throttle = 0.0

    def step(self) -> None:
        """Drive for one physics step."""
        self.episodes += not self.run.time
        self.advance()

    def advance(self) -> None:
        """Drive for one physics step, after which a car that has left the road is set back."""
        self.run.step(self.steering, self.throttle)

    @property
    def sector(self) -> str:
        """The number of the sector in which the car is; each lap begins in sector 0."""
        return str(int(max(0.0, self.run.travelled) % self.track.length // SECTOR))

    def obey(self, data: Any) -> bool:
        """Drive as an event's data say; return whether they can be used, and tell once if they cannot."""
        answer = parse_commands(data)
        if answer:
            self.apply(answer)
        else:
            program.warn_once(f"an answer cannot be used: it must have {USABLE}")
        return answer is not None

    def handle(self, event: str, data: Any) -> bool:
        """Do what an event says; return whether it answers a telemetry. Raises UserError."""
        raise NotImplementedError

    def telemetry(self) -> str:
        """Return the packet for the present state."""
        raise NotImplementedError

    def frame(self) -> np.ndarray:
        """Render the centre camera, once for each state, since a frame's drops and flakes depend on how many it had.

        uint8 (160, 320, 3), RGB.
        """
        if self.seen < self.run.time:
            self.seen, self.image = self.run.time, self.views[0].frames(self.run.car.node.get_transform())[0]
        return self.image

    def state(self, speed_unit: float = 1.0) -> dict[str, str]:
        """Return what all dialects tell; speed_unit: m/s."""
        x, y, z = self.run.car.node.get_pos()
        return {
            "steering_angle": f"{FULL_LOCK * self.steering:.4f}",
            "throttle": f"{self.throttle:.4f}",
            "speed": f"{self.run.car.speed / speed_unit:.4f}",
            "cte": f"{self.run.offset:.4f}",
            "image": base64.b64encode(jpeg(self.frame())).decode(),
            "pos_x": f"{x:.4f}",
            "pos_y": f"{z:.4f}",
            "pos_z": f"{y:.4f}",
        }


class Measures(Dialect):
    """Telemetry with lap, waypoint, out-of-bound episodes and so on; steering as usual.

    `crash` marks a departure, as in the real simulator: programs find failures by it. Nothing can be crashed into.
    """

    max_laps = math.inf

    def handle(self, event: str, data: Any) -> bool:
        """Steer, or drive on as before; remember after how many laps it is over."""
        if event != "steer" or not self.obey(data):
            return event == "manual"
        laps = data.get("max_laps")
        if str(laps).isdecimal():
            self.max_laps = float(laps)  # int() refuses thousands of digits
        elif laps is not None:
            program.warn_once(f'"max_laps" {str(laps)[:40]!r} is no number of laps, and is ignored')
        return True

    def advance(self) -> None:
        """Drive for one physics step, and finish with the last lap."""
        laps = self.run.laps
        super().advance()
        self.over = self.over or laps < self.run.laps >= self.max_laps

    def telemetry(self) -> str:
        """Return the usual telemetry, speed in mph, and the measures."""
        run = self.run
        more = {
            "brake": f"{max(0.0, -self.throttle):.4f}",
            "lapNumber": str(run.laps + 1),
            "currentWayPoint": self.sector,
            "crash": str(int(any(run.time - left.time < CRASHED for left in run.departures[-1:]))),
            "tot_obes": str(len(run.departures)),
            "tot_crashes": "0",
            "distance": f"{run.distance:.4f}",
            "sim_time": str(int(run.time + 1e-6)),  # whole seconds: ThirdEye reads an int
            "ang_diff": f"{abs(math.degrees(run.lane[1])):.4f}",
        }
        return event_packet("telemetry", self.state(MPH) | more)


class Roads(Dialect):
    """Roads sent as text; the car stays where it leaves them until the program sets it back. Speed is in m/s.

    A weather is seen at once, and on the roads sent after it. Its intensity is not used.
    These programs answer at once, with what their driver, in another thread, has commanded last.
    """

    apart = True

    def __init__(self, stage: Stage):
        super().__init__(stage)
        self.text = ""  # of the road that lies there
        self.still = True
        self._last: Any = None  # data of the last answer

    def handle(self, event: str, data: Any) -> bool:
        """Steer, lay a road, or set the car back at its start. Raises TrackError for a text that is no road."""
        self.same, self._last = event == "steer" and data == self._last, data
        if event == "weather" and isinstance(data, dict):
            weather = ROAD_WEATHERS.get(str(data.get("type")), "sunny")
            if weather != self.weather:
                self.weather = weather
                self.show()
            return True
        if event == "steer":
            self.still = self.run.at_end
            return self.obey(data)
        if event == "reset":
            if self.run.time:
                self.restart()
            self.still = True
            return True
        if event != "track":
            return False
        text = data.get("track_string") if isinstance(data, dict) else None
        if not isinstance(text, str):
            raise TrackError('the program\'s event "track" has no text "track_string"')
        self.text, self.still = text, True
        try:  # programs check their roads by rules of their own, so a faulty course is laid all the same
            road = make_road(parse_track_string(self.text), name="sent", checked=False, **self.stage.road)
        except TrackError as error:
            raise TrackError(f"the program's track_string: {error}") from None
        self.open(road)
        return True

    def advance(self) -> None:
        """Drive for one physics step; at the road's end, the car stops."""
        self.run.advance(self.steering, self.throttle)
        if abs(self.run.offset) > LOST:
            self.run.set_back()
        self.still = self.run.at_end

    def telemetry(self) -> str:
        """Return the telemetry with the road that lies there and what was hit: the end of the road, or none."""
        yaw = math.pi / 2 - self.run.car.heading  # from north to the right, as in Unity
        turn = (0.0, math.sin(yaw / 2), 0.0, math.cos(yaw / 2), 0.0, math.degrees(yaw) % 360, 0.0)
        more = {
            "cte_pid": f"{self.run.offset:.4f}",
            "hit": ROAD_END if self.run.at_end else "none",
            "track": self.text,
            "angl": f"{-math.degrees(self.run.lane[1]):.4f}",  # right positive, from the car's heading to the road's
            # The car's attitude, of which only the heading is told: a quaternion x, y, z, w and Euler angles in degrees
            **{f"angle{i}": f"{value:.6f}" for i, value in enumerate(turn, 1)},
        }
        return event_packet("telemetry", self.state() | more)


class Episodes(Dialect):
    """Episodes on a named track, in a weather, by day or through day and night; with pauses, metrics and segments.

    Telemetry goes on in a pause, because the program resumes in its answer to one. Speed is in m/s.
    """

    more = 0.003  # after its action, the program sends whether to go on, and perhaps another episode
    apart = True

    def __init__(self, stage: Stage):
        super().__init__(stage)
        self.day, self.ready = True, False
        self.events: list[dict[str, str]] = []  # of this episode, as the program knows them
        self._last: Any = None  # data of the last action

    def build(self, source: str | PointRoad) -> list[scenery.Scenery]:
        """Return the scenery in its weather, and the same in the colours of its segments."""
        (built,) = super().build(source)
        self.tone = built.tone  # of the camera by day
        return [built, segments(built)]

    def handle(self, event: str, data: Any) -> bool:
        """Steer, start or end an episode, pause or go on. Raises UserError for an unknown track or weather."""
        if event == "action":
            self.same, self._last = data == self._last, data
            return self.obey(data)
        if event in ("pause_sim", "resume_sim"):
            self.still = event == "pause_sim"
            self.tell("sim_paused" if self.still else "sim_resumed", {})
        elif event == "end_episode":
            self.still = True
            self.tell("episode_metrics", self.metrics())
            self.tell("episode_events", {"events": self.events})
            self.tell("episode_ended", {})
        elif event == "start_episode" and isinstance(data, dict):
            wanted = {"weather_name": "sunny", "daytime_name": "day"} | data  # some programs name only the track
            self.start(*(str(wanted.get(key)) for key in ("track_name", "weather_name", "daytime_name")))
            self.tell("episode_started", {})
        return False

    def tell(self, event: str, data: Any) -> None:
        """Send the program an event."""
        self.replies.append(event_packet(event, data))

    def start(self, track: str, weather: str, daytime: str) -> None:
        """Begin an episode; daytime: "day" or "daynight". Raises UserError."""
        if daytime not in ("day", "daynight"):
            raise TrackError(f"{daytime[:40]}: there is no such daytime; there are day and daynight")
        source: str | PointRoad = TRACKS.get(track, track)
        changed = (source, weather) != (self.track.source, self.weather)
        self.weather = weather
        self.day = daytime == "day"
        if changed:
            self.open(source, self.stage.direction)
        else:
            self.restart()
        self.ready, self.still, self.events = True, False, []

    def advance(self) -> None:
        """Drive for one physics step, and tell the program if the car has left the road."""
        super().advance()
        for left in self.run.departures[len(self.events) :]:
            self.events.append(
                {
                    "timestamp": str(int(1000 * time.time())),  # ms of real time, as programs stamp what they receive
                    "key": "out_of_track",
                    "value": left.side,
                    "sector": self.sector,
                    "pos_x": f"{left.x:.4f}",
                    "pos_z": f"{left.y:.4f}",
                    "time": f"{left.time:.2f}",
                    "speed": f"{left.speed:.4f}",
                }
            )
            self.tell("episode_event", self.events[-1])

    def metrics(self) -> dict[str, str | int]:
        """Return the measures of the episode that ends; m, s and m/s. The real simulator has only the counts."""
        run = self.run
        offset = np.abs(run.trajectory.offset or [0.0])
        return {
            "collisionCount": 0,
            "outOfTrackCount": len(run.departures),
            "track": run.track.name,
            "time": f"{run.time:.2f}",
            "distance": f"{run.distance:.2f}",
            "laps": str(run.laps),
            "mean_cte": f"{offset.mean():.4f}",
            "max_cte": f"{offset.max():.4f}",
            "mean_speed": f"{run.distance / run.time if run.time else 0.0:.4f}",
        }

    def frame(self) -> np.ndarray:
        """Render the centre camera, darker at night."""
        scene = self.views[0].scene
        light = 1.0 if self.day else (1 + DARKEST) / 2 + (1 - DARKEST) / 2 * math.cos(2 * math.pi * self.run.time / DAY)
        tone = np.eye(3, 4, dtype=np.float32) if self.tone is None else self.tone
        scene.scenery = replace(scene.scenery, tone=self.tone if light == 1 else (tone * light).astype(np.float32))
        return super().frame()

    def telemetry(self) -> str:
        """Return the telemetry with lap, sector and the image of the segments, a PNG."""
        run = self.run
        pose, (x, y, _), far = run.car.heading, run.car.node.get_pos(), AHEAD * run.car.speed
        ahead = self.track.locate(x + far * math.cos(pose), y + far * math.sin(pose), run.s)[1]
        colours = self.views[1].segments(run.car.node.get_transform())
        encoded, png = cv2.imencode(".png", cv2.cvtColor(colours, cv2.COLOR_RGB2BGR))
        assert encoded
        more = {
            "next_cte": f"{ahead:.4f}",
            "angular_difference": f"{math.degrees(run.lane[1]):.4f}",
            "lap": str(run.laps + 1),
            "sector": self.sector,
            "semantic_segmentation": base64.b64encode(png.tobytes()).decode(),
        }
        return event_packet("car_telemetry", self.state() | more)


DIALECTS: dict[str, Callable[[Stage], Dialect]] = {"measures": Measures, "roads": Roads, "episodes": Episodes}
