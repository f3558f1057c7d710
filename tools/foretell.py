"""Find a network's limits: fit what foretells that it will leave the road, and measure how well it does so.

    python -m tools.foretell                                # the network that comes with the project
    python -m tools.foretell model.pt --recordings data     # it also drives in these recordings

The network drives in the stand-in simulator: generated roads and both tracks in foul weather, mountain roads at 25 mph,
and ordinary roads at 15; and in replays of recordings, whose frames differ from drawn ones. Numbers of roads and looks
above 2000, the disturbances of which networks may be trained, and the recordings tune the figures; numbers below 1000
and the other disturbances, on which nothing was tuned, measure them. Departures are rare, so what is fitted is how far
from the lane's centre the car will be, which every drive tells. The figures are written beside the network, as
model.limits.pt; from then on drive.py shows the risk.

The measure is SelfOracle's (ICSE 2020): a departure is foretold by an alarm 1 to 6 s before it, and false alarms are
counted in windows of 5 s in drives without a departure. An interrupted run continues when it is started again. A drive
takes about 5 s on a core.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.errors import UserError
from cloning.base.files import written_whole
from cloning.base.outputs import claimed
from cloning.lane.foretell import (
    ALARM,
    EARLIEST,
    LATEST,
    MEAN_TIMES,
    STEEPNESS,
    Blindness,
    Limits,
    Observation,
    Observer,
    Ordinary,
    Signs,
    fingerprint,
    limits_file,
    odds_of_one,
    save_limits,
)
from cloning.lane.pilot import Pilot
from cloning.network.compute import one_thread, threads
from cloning.network.network import SHIPPED_MODEL, load_model
from cloning.recordings.format import SAMPLE_RATE
from cloning.recordings.images import decode
from cloning.recordings.log import Recording, find_folders
from cloning.recordings.writer import SampleClock
from cloning.replay.replay import ReferenceLine, ReplayFrame, load_recording, reference_lines
from cloning.replay.replay import drive as replay
from cloning.road.autonomy import LIMITS
from cloning.road.disturbances import HELD_OUT, KINDS, Disturbance, Disturber
from cloning.road.motion import MPH
from cloning.road.track import Track
from cloning.server.speed import SpeedController
from simulator.benchmark.scores import windows
from simulator.cameras import jpeg
from simulator.driving import cameras_at
from simulator.run import Run
from simulator.workers import results, started_workers
from tools.command import head, row
from tools.lane_frames import every_second_shadowed

DISTURBED, HARD, ORDINARY = "disturbed, strength 5, 25 mph", "mountain roads, 25 mph", "ordinary roads, 15 mph"
CONDITIONS = (DISTURBED, HARD, ORDINARY)
REPLAYED = "replays of recordings"  # which only tune
PIECE = 40.0  # s of a replay, which count as a drive
MAX_DEPARTURES = 4  # in a drive: more are at the same place
# Shares of the windows without a departure, in drives for tuning: in which there is an alarm (there are more of them in
# drives on which nothing was tuned: 5 %), and in which any one sign is extreme.
FALSE_ALARMS, RARE = 0.04, 0.002
# A car is stopped by so many log odds above an alarm, and above all but this share of the windows in clear drives for
# tuning.
MARGIN, NEEDLESS = 0.25, 0.01
NEVER = 100.0  # the logarithm of no sign
OFF_ROAD = 4.0  # m from the centre: taken for where a car is that leaves the road
NEAR = 0.1  # m added to distances before their logarithm is taken: a car on the centre is not infinitely better
DECAY = 0.1  # of the regression's weights


class Course(NamedTuple):
    """What is driven; number: of the road and its look, and of the random start; disturbance: "" for none."""

    kind: str
    track: str
    number: int
    disturbance: str = ""

    @property
    def tunes(self) -> bool:
        """Whether the drive tunes the figures; others measure them."""
        return self.number > 2000

    @property
    def name(self) -> str:
        """The name of its file."""
        return "-".join([self.track, str(self.number), self.kind[:4], self.disturbance.replace(":", "")])


def courses() -> list[Course]:
    """Return all that is driven, in an order in which any beginning has some of everything."""
    lists = []
    for first, kinds in ((2001, [kind for kind in KINDS if kind not in HELD_OUT] * 8), (1, list(HELD_OUT) * 14)):
        tracks = [("lake", "jungle", f"road-{first + i}")[(i + i // 15) % 3] for i in range(len(kinds))]
        foul = [Course(DISTURBED, track, first + i, f"{kinds[i]}:5") for i, track in enumerate(tracks)]
        hard = [Course(HARD, f"mountain-{first + i}", first + i) for i in range(30)]
        some = [(f"road-{first + i}", "lake", f"road-{first + i}", "jungle")[i % 4] for i in range(100, 124)]
        lists += [foul, hard, [Course(ORDINARY, track, first + 100 + i) for i, track in enumerate(some)]]
    return [course for _, course in sorted((i / len(each), course) for each in lists for i, course in enumerate(each))]


class Drive(NamedTuple):
    """What was seen in a drive, and when the car left the road."""

    seen: Observation  # each array with a row for each frame
    blind: np.ndarray  # float64 (n,): m driven since a frame showed anything new
    time: np.ndarray  # float64 (n,): s
    away: np.ndarray  # float64 (n,): m from the lane's centre
    departures: np.ndarray  # float64 (k,): s


def joined(seen: Sequence[Observation]) -> Observation:
    """Return the observations of single frames as those of a drive."""
    return Observation(*map(np.stack, zip(*seen, strict=True)))


@cache
def observer(model: Path) -> Observer:
    """Return this process's observer of a network."""
    one_thread()
    return Observer(load_model(model))


def drive(model: Path, course: Course) -> Drive:
    """Drive a course, from a random start on; after a departure the car is put back on the road."""
    observe, cameras = observer(model), cameras_at(course.track, every_second_shadowed(course.number))
    run = Run(Track(course.track, ("ccw", "cw")[course.number // 2 % 2]), "autonomous")
    run.s = float(np.random.default_rng(course.number).uniform(0, run.track.length))
    run.set_back()
    disturber = Disturber(Disturbance.parse(course.disturbance), course.number) if course.disturbance else None
    controller, clock = SpeedController(15 if course.kind == ORDINARY else 25), SampleClock(1 / SAMPLE_RATE)
    seen, blind, time, away = list[Observation](), list[float](), list[float](), list[float]()

    def steer(frame: np.ndarray) -> float:
        seen.append(observe(frame))
        return seen[-1].steering.item()

    pilot, blindness = Pilot(steer), Blindness()
    while run.time < (30 if disturber else 40) and len(run.departures) < MAX_DEPARTURES:
        frame = decode(jpeg(cameras.frames(run.car.node.get_transform())[0]))
        frame, speed = disturber(frame) if disturber else frame, run.speed_mph * MPH
        steering = float(pilot(frame, run.time, speed)[0])
        blind.append(blindness(pilot.seen, run.time, speed))
        time.append(run.time)
        away.append(abs(run.offset))
        throttle, due = controller.throttle(run.speed_mph), False
        while not due:
            run.step(steering, throttle)
            due = clock.due(run.time)
    departures = [departure.time for departure in run.departures]
    return Drive(joined(seen), *map(np.array, (blind, time, away, departures)))


def drive_into(folder: Path, model: Path, course: Course) -> None:
    """Drive a course, and save what was seen, if that is not there yet. Raises OSError."""
    path = folder / f"{course.name}.npz"
    if not path.exists():
        driven = drive(model, course)
        with written_whole(path) as unfinished, open(unfinished, "wb") as file:
            np.savez(file, *driven.seen, *driven[1:])


def load(path: Path) -> Drive:
    """Return what `drive_into` saved."""
    with np.load(path) as saved:
        *seen, blind, time, away, departures = saved.values()
    return Drive(Observation(*seen), blind, time, away, departures)


def replay_line(observe: Observer, recording: Recording, line: ReferenceLine) -> Drive:
    """Let the network drive along a line of a recording; set back onto it, it counts as having left the road."""
    blindness, seen, blind = Blindness(), list[Observation](), list[float]()

    def steer(frame: ReplayFrame) -> float:
        image = decode(frame.jpeg())
        seen.append(observe(image))
        blind.append(blindness(image, float(recording.time[frame.row]), frame.speed * MPH))
        return float(seen[-1].steering)

    done = replay(recording, [line], LIMITS[-1], steer)
    time = recording.time[done.row]
    return Drive(joined(seen), np.array(blind), time, np.abs(done.offset), time[list(done.interventions)])


def replays(observe: Observer, folder: Path) -> list[tuple[Course, Drive]]:
    """Return the network's drives in a recording, PIECE s each, which tune the figures. Raises RecordingError."""
    recording, found = load_recording(folder), list[tuple[Course, Drive]]()
    for line in reference_lines(recording):
        driven = replay_line(observe, recording, line)
        piece = (driven.time - driven.time[0]) // PIECE
        for each in np.unique(piece):
            blind, time, away = (column[piece == each] for column in driven[1:4])
            left = driven.departures[(driven.departures >= time[0]) & (driven.departures <= time[-1])]
            course = Course(REPLAYED, str(folder), 2001 + len(found))
            seen = Observation(*(values[piece == each] for values in driven.seen))
            found.append((course, Drive(seen, blind, time, away, left)))
    return found


# ----------------------------------------------------------------------------------------------------------------------
# Figures


class Part(NamedTuple):
    """A part of a drive without an interruption; blind, time, away: of the drive, (n,)."""

    kind: str
    signs: np.ndarray  # float32 (n, k)
    blind: np.ndarray
    time: np.ndarray
    away: np.ndarray
    departure: float | None  # when the car left the road at the part's end, None if it did not

    @property
    def coming(self) -> np.ndarray:
        """The greatest distance from the centre LATEST to EARLIEST s later, (n,), m; NaN where the part ends before."""
        found = np.full(len(self.time), np.nan)
        for at, now in enumerate(self.time):
            later = self.away[(self.time >= now + LATEST) & (self.time < now + EARLIEST)]
            if self.departure is not None and self.departure - now <= EARLIEST:
                found[at] = OFF_ROAD
            elif len(later):
                found[at] = later.max()
        return found


def parts(ordinary: Ordinary, course: Course, driven: Drive) -> Iterator[Part]:
    """Yield what comes before each departure of a drive, or all of a drive without one."""
    for begin, end in pairwise([-1.0, *(driven.departures.tolist() or [np.inf])]):
        rows, signs = np.flatnonzero((driven.time > begin) & (driven.time <= end)), Signs(ordinary)
        if len(rows):
            each = (Observation(*(values[at] for values in driven.seen)) for at in rows)
            found = np.stack([signs(seen, driven.time[at]) for at, seen in zip(rows, each, strict=True)])
            blind, time, away = (values[rows] for values in (driven.blind, driven.time, driven.away))
            yield Part(course.kind, found, blind, time, away, end if np.isfinite(end) else None)


def greatest(part: Part, risk: np.ndarray) -> list[float]:
    """Return the greatest risk in each whole window of a part, or in the one that foretells its departure."""
    time = part.time - part.time[0]
    departures = [part.departure - part.time[0]] if part.departure is not None else []
    found = [risk[(begin <= time) & (time < end)] for begin, end in windows(departures, time[-1])]
    return [each.max() for each in found if len(each)]


def regress(signs: np.ndarray, away: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the weights (k,) with which signs (n, k) tell the logarithm of a distance, by ridge regression.

    away: (n,), m. share: (n,), how much a row counts, together 1.
    """
    deviation = signs.std(0) + 1e-3
    inputs, wanted = (signs - share @ signs) / deviation, np.log(away + NEAR)
    weighted = inputs.T * share
    weights = np.linalg.solve(weighted @ inputs + DECAY * np.eye(len(deviation)), weighted @ (wanted - share @ wanted))
    return (weights / deviation).astype(np.float32)


def fit(driven: Sequence[tuple[Course, Drive]]) -> Limits:
    """Return the limits; driven: what tunes them. Raises UserError for a network that drives nowhere."""
    fair = [(course, each) for course, each in driven if not course.disturbance and not len(each.departures)]
    lost = UserError("the network leaves the road in nearly every clear drive, so nothing is ordinary; train it longer")
    if not fair:
        raise lost
    # Every second one says what is ordinary: in these the networks' activations are nearer to it than in any others.
    known = {course for course, _ in fair[::2]}
    seen = [each.seen for course, each in fair if course in known]
    ordinary = Ordinary.of(Observation(*map(np.concatenate, zip(*seen, strict=True))))
    drives = [list(parts(ordinary, course, each)) for course, each in driven if course not in known]
    coming = [np.concatenate([part.coming for part in each]) for each in drives]
    told = [np.isfinite(each) for each in coming]
    share = [rows / max(rows.sum(), 1) / len(drives) for rows in told]  # each drive counts the same
    tuned, rows = [part for each in drives for part in each], np.concatenate(told)
    signs = np.concatenate([part.signs for part in tuned])[rows]
    weights = STEEPNESS * regress(signs, *(np.concatenate(each)[rows] for each in (coming, share)))

    def stayed(figure: Callable[[Part], np.ndarray]) -> list[np.ndarray]:
        return [risks(tuned, kind, figure)[1] for kind in (*CONDITIONS, REPLAYED)]

    def sign(at: int) -> Callable[[Part], np.ndarray]:
        return lambda part: part.signs[:, at]

    of_all, extreme = stayed(lambda part: part.signs @ weights), np.full(len(weights) // len(MEAN_TIMES), NEVER)
    if not sum(map(len, of_all)):
        raise lost
    if sum(map(len, of_all)) >= 1 / RARE:  # fewer windows can't tell what is rare
        extreme = np.array([exceeded(stayed(sign(at)), RARE) for at in range(len(extreme))])
    of_one = stayed(lambda part: odds_of_one(part.signs, extreme))
    alarm, stop = thresholds(of_all, of_one)
    return Limits(ordinary, weights, extreme.astype(np.float32), -alarm, stop)


def thresholds(of_all: Sequence[np.ndarray], of_one: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the odds from which it is an alarm, and the risk at which a car is better stopped.

    of_all, of_one: the greatest odds by all signs, and by one alone, in the windows without a departure of disturbed
    drives and of each kind of clear ones. Where one sign is extreme, there is an alarm whatever the others tell.
    """
    alarm = exceeded([np.where(one > 0, np.inf, each) for each, one in zip(of_all, of_one, strict=True)], FALSE_ALARMS)
    _, *clear = (np.maximum(each - alarm, one) for each, one in zip(of_all, of_one, strict=True))
    stop = max(0, np.quantile(np.concatenate([*clear, [0]]), 1 - NEEDLESS)) + MARGIN
    return alarm, float(1 / (1 + np.exp(-stop)))


def exceeded(highest: Sequence[np.ndarray], share: float) -> float:
    """Return what the highest values of this share of the windows exceed; each kind of drive counts the same."""
    alike = np.concatenate([np.full(len(each), 1 / len(each)) for each in highest if len(each)])
    return float(np.quantile(np.concatenate(highest), 1 - share, weights=alike, method="inverted_cdf"))


def risks(among: Sequence[Part], kind: str, risk: Callable[[Part], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the greatest risks in the windows before departures, and in those of drives without one."""
    found: tuple[list[float], list[float]] = ([], [])
    for part in among:
        if part.kind == kind:
            found[part.departure is None].extend(greatest(part, risk(part)))
    return np.array(found[0]), np.array(found[1])


def table(limits: Limits, driven: Sequence[tuple[Course, Drive]]) -> str:
    """Return how well departures are foretold, in Markdown; driven: what measures it."""
    found = [part for course, each in driven for part in parts(limits.ordinary, course, each)]
    rows = [head("", "departures", "foretold", "by as many alarms at random", "windows without a departure", "alarms")]
    total: list[tuple[np.ndarray, np.ndarray]] = []

    def add(name: str, before: np.ndarray, without: np.ndarray) -> None:
        alarms = np.concatenate([before, without]) >= ALARM
        foretold, at_random, false = (
            f"{100 * values.mean():.{digits}f} %" if len(values) else ""
            for values, digits in ((before >= ALARM, 0), (alarms, 0), (without >= ALARM, 1))
        )
        rows.append(row(name, len(before), foretold, at_random, len(without), false))

    for kind in CONDITIONS:
        total.append(risks(found, kind, lambda part: limits.risk(part.signs, part.blind)))
        add(kind, *total[-1])
    add("**all**", *map(np.concatenate, zip(*total, strict=True)))
    return "\n".join(rows)


def main(argv: list[str] | None = None) -> int:
    """Drive, fit, measure; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.foretell", __doc__)
    add = parser.add_argument
    model = "model file (default: the project's own, whose limits are then replaced)"
    add("model", nargs="?", type=Path, default=SHIPPED_MODEL, help=model)
    recordings = "recordings, or folders of them, in which it drives, too: fewer false alarms on real roads"
    add("--recordings", nargs="*", default=[], help=recordings)
    drives = "how many drives; fewer have some of each kind, too (default %(default)s, which is all)"
    add("--drives", type=number(int, 20, len(courses())), default=len(courses()), help=drives)
    add("--folder", type=Path, default=Path("foretell"), help="for what the drives show (default %(default)s)")
    options = parser.parse_args(argv)
    observe, chosen = observer(options.model), courses()[: options.drives]
    # Another network drives otherwise, and so did earlier versions of the pilot.
    folder = options.folder / f"{fingerprint(observe.network)[:8]}-mounted"
    work = partial(drive_into, folder, options.model)
    with claimed(folder):
        replayed = [each for folder in find_folders(options.recordings) for each in replays(observe, folder)]
        with started_workers(threads()) as pool:
            list(results(pool, work, chosen, "drive"))  # raises their errors
    driven = [(course, load(folder / f"{course.name}.npz")) for course in chosen]
    limits = fit([each for each in driven + replayed if each[0].tunes])
    save_limits(options.model, observe.network, limits)
    print(table(limits, [each for each in driven if not each[0].tunes]))
    print(f"\n{limits_file(options.model)}: written; a car is better stopped at a risk of {limits.stop:.2f}")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
