"""Measure how recordings are placed on the known tracks after they were damaged, and that no other road is.

    python -m tools.placing data/lake-ccw data/jungle    # these recordings, and rendered drives

Each kind of damage is done to a copy in memory, about every 40 seconds: the car is stuck, spun, pushed back and so on.
Damage may cost its own rows alone. The truth is where the undamaged recording is placed, or what its lane.csv says. Of
generated roads, alone or within a recording of a known track, nothing may be placed.
"""

import copy
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.table import Column, Table
from cloning.lane.known import known_position
from cloning.lane.localise import localise_recording, shipped_networks
from cloning.lane.reader import MOUNT_OFFSETS, LaneNetwork, estimate_centres, extract_strip, read_strips
from cloning.recordings.log import Recording, find_folders
from cloning.replay.replay import load_recording
from cloning.replay.views import StretchViews
from cloning.road.motion import Stretch, stretch_rows, stretches
from cloning.road.track import ROADS, Track
from simulator.record import record
from tools.command import head, row
from tools.lane_frames import shadowed

SPACING = (500, 700)  # rows between two damages
PAUSE = 1 / 15  # s between rows that damage adds
# Track, direction, mph, look: in looks and on roads that no network was trained on.
RENDERED = (("lake", "ccw", 30, 1000), ("lake", "cw", 20, shadowed(1001)), ("jungle", "cw", 25, shadowed(1002)))
RENDERED_FOREIGN = (("road-3", "ccw", 15, 1003), ("road-6", "cw", 20, 1006), ("road-9", "ccw", 30, shadowed(1009)))
SPLICED, SHORT_PAUSE = (70, 300), 2.0  # rows of another road within a recording, and s before and after them


@dataclass(frozen=True)
class Drive(Table):
    """The rows of a damaged recording.

    source           int (n,): the recording's row whose frames are shown
    steering, speed  float (n,): as logged, -1..1 and mph
    pause            float (n,): s since the row before
    undamaged        bool (n,)
    right, yaw       float (n,): the pose from which the frames are seen, m and radians from the recorded one
    """

    source: Column
    steering: Column
    speed: Column
    pause: Column
    undamaged: Column
    right: Column
    yaw: Column

    @staticmethod
    def of(recording: Recording) -> "Drive":
        """Return all rows of a recording, undamaged."""
        n, pause = len(recording), np.diff(recording.time, prepend=recording.time[0])
        numbers = recording.steering.astype(float), recording.speed.astype(float), pause
        return Drive(np.arange(n), *numbers, np.ones(n, bool), np.zeros(n), np.zeros(n))

    def log(self, recording: Recording) -> Recording:
        """Return the damaged recording, whose frames are those of the rows' sources."""
        logged = {name: getattr(self, name).astype(np.float32) for name in ("steering", "speed")}
        return recording.take(self.source, time=recording.time[0] + np.cumsum(self.pause), **logged)

    def added(self, source: np.ndarray, steering: np.ndarray | float, speed: np.ndarray | float) -> "Drive":
        """Return damaged rows that show these sources."""
        n = len(source)
        numbers = np.full(n, steering, float), np.full(n, speed, float), np.full(n, PAUSE)
        return Drive(source, *numbers, np.zeros(n, bool), np.zeros(n), np.zeros(n))

    def spoilt(self, start: int, end: int, **changed: np.ndarray | float) -> "Drive":
        """Return the drive with other values in these rows, which count as damaged."""
        values = {name: np.array(getattr(self, name)) for name in (*changed, "undamaged")}
        for name, value in {**changed, "undamaged": False}.items():
            values[name][start:end] = value
        return replace(self, **values)


Damage = Callable[[Drive, int, np.random.Generator], Drive]


def insert(drive: Drive, at: int, added: Drive, skip: int = 0) -> Drive:
    """Return a drive with rows added before row `at`, from which `skip` rows are left out (negative: repeated)."""
    return Drive.joined([drive.take(slice(at)), added, drive.take(slice(at + skip, None))])


# Each kind of damage takes a drive, the row at which it happens, and random numbers. Rows after it are as they were.


def stuck(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The car stands at a rock at full lock, its wheels spin."""
    n = int(rng.integers(20, 60))
    return insert(drive, at, drive.added(np.full(n, drive.source[at]), rng.choice((-1, 1)), rng.uniform(2.3, 5, n)))


def crashed(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The car hits something, is thrown back some metres, and drives on from there."""
    standing, back = int(rng.integers(5, 15)), int(rng.integers(10, 25))
    source = np.r_[np.full(standing, drive.source[at]), drive.source[at - back : at + 1][::-1]]
    speed = np.r_[np.linspace(drive.speed[at], 2.5, standing), rng.uniform(3, 8, back + 1)]
    return insert(drive, at, drive.added(source, rng.uniform(-1, 1, len(source)), speed), -back)


def reversed_(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The car goes backwards for a while; the log has no sign for it."""
    back = int(rng.integers(20, 60))
    rows = slice(at - back, at)
    added = drive.added(drive.source[rows][::-1], drive.steering[rows][::-1], drive.speed[rows][::-1])
    return insert(drive, at, added, -back)


def spun(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The car turns to a side and back, without the log's steering for it."""
    n = int(rng.integers(20, 40))
    yaw = rng.choice((-1, 1)) * 1.2 * np.sin(np.linspace(0.1, np.pi - 0.1, n))
    return drive.spoilt(at, at + n, yaw=yaw, right=yaw)


def off_road(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The car leaves the road and returns, without the log's steering for it."""
    n = int(rng.integers(40, 80))
    right = rng.choice((-1, 1)) * 7 * np.sin(np.linspace(0.1, np.pi - 0.1, n))
    return drive.spoilt(at, at + n, right=right, yaw=np.gradient(right) / 0.9)


def stopped_at_a_post(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The car leaves the road, stops, wheels spinning, and is driven back while nothing is recorded."""
    n, standing = int(rng.integers(15, 30)), int(rng.integers(20, 50))
    right = rng.choice((-1, 1)) * np.linspace(0.2, 6, n)
    drive = drive.spoilt(at, at + n, right=right, yaw=np.gradient(right) / 0.9)
    added = drive.added(np.full(standing, drive.source[at + n]), rng.uniform(-1, 1), rng.uniform(2.3, 4, standing))
    added = replace(added, right=np.full(standing, right[-1]), yaw=np.full(standing, drive.yaw[at + n - 1]))
    return paused(insert(drive, at + n, added), at + n + standing, rng.uniform(5, 60))


def paused(drive: Drive, at: int, seconds: float) -> Drive:
    """Return a drive with a longer pause before a row."""
    return replace(drive, pause=drive.pause + seconds * (np.arange(len(drive)) == at))


def clock_changed(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The recording computer's clock jumps."""
    return paused(drive, at, rng.choice((3, 3600)))


def rows_cut(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """Rows are cut out: the time stamps tell it."""
    n = int(rng.integers(3, 90))
    return paused(insert(drive, at, drive.take(slice(0)), n), at, float(drive.pause[at : at + n].sum()))


def cut_to_pieces(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """Rows are cut out so that pieces of 70 rows are left between them."""
    for _ in range(3):
        drive, at = rows_cut(drive, at, rng), at + 70
    return drive


def frozen(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The frames stand still while the car goes on."""
    n = int(rng.integers(5, 60))
    return drive.spoilt(at, at + n, source=drive.source[at])


def teleported(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """The car is somewhere else from one row to the next, and drives on there."""
    return insert(drive, at, drive.take(slice(0)), int(rng.integers(100, 200)))


def mixed(drive: Drive, at: int, rng: np.random.Generator) -> Drive:
    """Any of the others."""
    kinds = DAMAGES[:-1]
    return kinds[int(rng.integers(len(kinds)))](drive, at, rng)


DAMAGES: tuple[Damage, ...] = (
    stuck,
    crashed,
    reversed_,
    spun,
    off_road,
    stopped_at_a_post,
    clock_changed,
    rows_cut,
    cut_to_pieces,
    frozen,
    teleported,
    mixed,
)


# The first row to damage, where it is not the 100th: a short piece before a long pause may be anywhere.
FIRST: dict[Damage, int] = {stuck: 0, stopped_at_a_post: 350, clock_changed: 350, mixed: 350}


def damaged(drive: Drive, damage: Damage, seed: int) -> Drive:
    """Return a drive with damage of a kind about every SPACING rows."""
    rng = np.random.default_rng(seed)
    places = np.cumsum(np.r_[FIRST.get(damage, 100), rng.integers(*SPACING, len(drive) // SPACING[0])])
    for at in places[places < len(drive) - 250][::-1].tolist():
        drive = damage(drive, at, rng)
    return drive


class Source:
    """A recording in memory: its strips, what the networks detect in them, and where the car is.

    is_driven  bool (n,): rows that are part of a stretch
    road       (n,) names: the track of each row; others than the known ones are foreign
    true       float (n,), m right of the lane's centre, nan where unknown
    """

    def __init__(self, recording: Recording, road: str | None = None):
        """road: None for that on which it is placed. Raises the errors of `read_strips` and `known_position`."""
        self.recording, self.strips = recording, read_strips(recording)
        self.detected = {id(network): estimate_centres(self.strips, network) for network in shipped_networks()}
        self.is_driven = np.zeros(len(recording), bool)
        for rows in stretch_rows(recording):
            self.is_driven[rows] = True
        offset, placed_on = self.place(Drive.of(recording))
        known = known_position(recording)
        self.true = known.lateral_offset if known else offset
        self.road = np.full(len(recording), road) if road else placed_on

    def joined(self, other: "Source") -> "Source":
        """Return this recording and another one in one."""
        both, log = copy.copy(self), other.recording
        later = log.take(slice(None), time=log.time - log.time[0] + self.recording.time[-1] + PAUSE)
        both.recording = Recording.joined([self.recording, later])
        for name in ("strips", "is_driven", "road", "true"):
            setattr(both, name, np.concatenate([getattr(self, name), getattr(other, name)]))
        both.detected = {key: np.concatenate([found, other.detected[key]]) for key, found in self.detected.items()}
        return both

    def seen(self, drive: Drive) -> tuple[np.ndarray, np.ndarray]:
        """Return a drive's strips, and the rows in which they are not the recorded ones."""
        strips, moved = self.strips[drive.source], np.flatnonzero((drive.right != 0) | (drive.yaw != 0))
        views = StretchViews(self.recording, Stretch.of(self.recording, slice(0, len(self.recording))))
        for at in moved:
            poses = ((drive.right[at] + mount, drive.yaw[at]) for mount in MOUNT_OFFSETS)
            strips[at] = [extract_strip(views.view_from(int(drive.source[at]), *pose)) for pose in poses]
        return strips, moved

    def place(self, drive: Drive) -> tuple[np.ndarray, np.ndarray]:
        """Return the lateral offset in each row of a drive, nan where it is not placed, and the tracks' names."""
        strips, moved = self.seen(drive)

        def detect(network: LaneNetwork) -> np.ndarray:
            centres = self.detected[id(network)][drive.source]
            centres[moved] = estimate_centres(strips[moved], network)
            return centres

        log = drive.log(self.recording)
        found, parts = localise_recording(log, stretches(log), detect, strips.__getitem__, shipped_networks())
        offset, road = np.full(len(drive), np.nan), np.full(len(drive), "", "U20")
        for rows, localisation in parts:
            offset[rows], road[rows] = found.lateral_offset[rows], localisation.track.name
        return offset, road


def spliced(known: Source, foreign: Source, rows: int, pause: float) -> tuple[Source, Drive]:
    """Return a drive of a recording with rows of a foreign one in its middle; pause: s before and after these."""
    both, at = known.joined(foreign), len(known.recording) // 2
    start = len(known.recording) + (len(foreign.recording) - rows) // 2
    order = np.r_[0:at, start : start + rows, at : len(known.recording)]
    drive = Drive.of(both.recording).take(order)
    drive.pause[[at, at + rows]] = pause
    return both, drive


def measured(source: Source, drive: Drive) -> tuple[int, float, np.ndarray, int]:
    """Place a drive: how many undamaged rows it has, the share that is placed, their errors, rows on a wrong track."""
    offset, road = source.place(drive)
    counted = drive.undamaged & source.is_driven[drive.source] & np.isin(source.road[drive.source], list(ROADS))
    error = np.abs(offset - source.true[drive.source])[counted]
    wrong = (road != "") & (road != source.road[drive.source])
    placed = ~np.isnan(offset[counted])
    return len(placed), float(placed.mean()) if len(placed) else np.nan, error[~np.isnan(error)], int(wrong.sum())


def report(name: str, source: Source, drive: Drive) -> None:
    """Print the row of a drive."""
    rows, share, error, wrong = measured(source, drive)
    metres = [f"{value:.2f}" for value in (error.mean(), np.quantile(error, 0.95))] if len(error) else ["-", "-"]
    print(row(name, rows, f"{share:.1%}" if rows else "-", *metres, wrong), flush=True)


def rendered(folder: str, course: tuple[str, str, int, int], laps: float) -> Source:
    """Return a rendered drive. course: track, direction, mph, look."""
    name, direction, speed, look = course
    path = f"{folder}/{name}-{direction}-{look}"
    record(path, Track(name, direction), laps, speed, look, look)
    return Source(load_recording(path), name)


def main(argv: list[str] | None = None) -> int:
    """Print the table; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.placing", __doc__)
    add = parser.add_argument
    add("recordings", nargs="*", help="folders of recordings of a known track, each with a driving_log.csv")
    laps = "length of each rendered drive; 0: none (default %(default)s)"
    add("--laps", type=number(float, 0, 1e5), default=1.0, help=laps)
    add("--seed", type=int, default=1, help="of the damage (default %(default)s)")
    options = parser.parse_args(argv)
    print(head("drive", "undamaged rows", "placed", "mean error, m", "95 % below", "rows on a wrong track"))
    with tempfile.TemporaryDirectory() as folder:
        sources = {path.name: Source(load_recording(path)) for path in find_folders(options.recordings)}
        foreign = {}
        if options.laps:
            for course in RENDERED:
                sources[" ".join(map(str, course))] = rendered(folder, course, options.laps)
            for course in RENDERED_FOREIGN:
                foreign[" ".join(map(str, course))] = rendered(folder, course, options.laps)
        for name, source in sources.items():
            whole = Drive.of(source.recording)
            report(f"{name}, undamaged", source, whole)
            for damage in DAMAGES:
                report(f"{name}, {damage.__name__.strip('_')}", source, damaged(whole, damage, options.seed))
            for other, road in foreign.items():
                for rows in SPLICED:
                    report(f"{name}, {rows} rows of {other}", *spliced(source, road, rows, PAUSE))
                    report(f"{name}, {rows} rows of {other} between pauses", *spliced(source, road, rows, SHORT_PAUSE))
        for name, source in foreign.items():
            report(name, source, Drive.of(source.recording))
    return program.DONE


if __name__ == "__main__":
    program.run(main)
