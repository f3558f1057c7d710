"""The command `python -m simulator replay`: a model drives real recordings."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from cloning.errors import SimulatorError
from cloning.outputs import check_folders, run_all, write_json
from cloning.recordings.log import Recording, find_folders
from cloning.replay.drivers import ModelDriver, ServerDriver
from cloning.replay.replay import (
    Drive,
    Driver,
    ReferenceLine,
    ReplayFrame,
    Watcher,
    drive,
    load_recording,
    reference_lines,
)
from cloning.replay.score import ReplayFilm, ReplayReport, replay_report, report_text, write_plot

KEPT_ANSWERS = 1000  # views: drives at the same pose are few rows apart


@dataclass(frozen=True)
class Options:
    """The options of the command.

    folders                recordings, or folders of recordings
    model                  a model file, to drive with in this process; None: drive.py drives, over the wire
    host, port, wait       address of drive.py, and seconds to wait for it
    limits                 m from the reference line
    reference              "lane" or "human"
    report, picture, film  files to write, or None; the film shows the drives at the last limit
    """

    folders: list[str]
    model: str | None
    host: str
    port: int
    wait: float
    limits: Sequence[float]
    reference: str
    report: str | None
    picture: str | None
    film: str | None


def run(options: Options) -> None:
    """Replay the recordings at each limit, print their reports and write the files. Raises UserError.

    After an error or Ctrl-C, the files are still written, with the recordings replayed until then.
    """
    check_folders(options.report, options.picture, options.film)
    folders = find_folders(options.folders)
    in_process = options.model is not None
    driver = ModelDriver(options.model) if options.model else ServerDriver(options.host, options.port, options.wait)
    # One drive per limit; drives may run at the same time, so only the one at the last limit is filmed.
    watchers: dict[float, Watcher | None] = dict.fromkeys(options.limits)
    film = ReplayFilm(options.film) if options.film else None
    if film:
        watchers[options.limits[-1]] = film.watch
    reports: list[ReplayReport] = []

    def replay_all() -> None:
        for folder in folders:
            recording = load_recording(folder)
            lines = reference_lines(recording, options.reference == "lane")
            if film:
                film.begin(recording)
            drives = drive_at_limits(recording, lines, driver, watchers, in_process)
            reports.append(replay_report(recording, lines, drives, options.reference))
            print(report_text(reports[-1]), flush=True)
            if options.picture:
                path = Path(options.picture)
                path = path if len(folders) == 1 else path.with_stem(f"{path.stem}-{folder.name}")
                write_plot(path, recording, drives)

    steps: list[Callable[[], object]] = [replay_all, driver.close]
    if film:
        steps.append(film.close)
    if options.report:
        report = options.report
        steps.append(lambda: write_json(report, reports) if reports else None)
    run_all(*steps)


class AskedOnce:
    """A driver of several drives of a recording, which asks another driver only once about each view.

    Until the first intervention in a stretch, the drives at all limits are the same.
    """

    def __init__(self, driver: Driver):
        """driver: it must answer a view always alike."""
        self.driver, self.lock = driver, threading.Lock()
        self.answers: dict[tuple[int, float, float], Future[float]] = {}

    def __call__(self, frame: ReplayFrame) -> float:
        """Return the driver's steering, or raise its error; wait if another thread has asked and it computes still."""
        view = frame.row, *frame.pose
        with self.lock:
            is_new = view not in self.answers
            answer = self.answers.setdefault(view, Future())
            if len(self.answers) > KEPT_ANSWERS:
                del self.answers[next(iter(self.answers))]
        if is_new:
            try:
                answer.set_result(self.driver(frame))
            except BaseException as error:
                answer.set_exception(error)
        return answer.result()


def drive_at_limits(
    recording: Recording,
    lines: list[ReferenceLine],
    driver: Driver,
    watchers: dict[float, Watcher | None],
    parallel: bool,
) -> list[Drive]:
    """Return the drives of a recording at each limit, in the order of `watchers`.

    parallel: drive in a thread per limit, by a driver that answers a view always alike. If one drive fails, or on
    Ctrl-C, the others stop at their next row. Otherwise drive in this thread, which Ctrl-C interrupts also while it
    waits for a server.
    """
    rows = sum(len(line.stretch) for line in lines)
    stopped = threading.Event()
    driver = AskedOnce(driver) if parallel else driver

    def drive_at(limit: float) -> Drive:
        film = watchers[limit]
        name = f"{recording.folder.name}, limit {limit:g} m"
        with tqdm(total=rows, desc=name, unit="row", disable=None, leave=False) as bar:

            def watch(frame: ReplayFrame, done: Drive) -> None:
                if stopped.is_set():
                    raise SimulatorError("stopped")
                bar.update()
                if film:
                    film(frame, done)

            return drive(recording, lines, limit, driver, watch)

    if not parallel:
        return [drive_at(limit) for limit in watchers]
    with ThreadPoolExecutor(len(watchers)) as pool:
        drives = [pool.submit(drive_at, limit) for limit in watchers]
        try:
            return [done.result() for done in drives]
        except BaseException:
            stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
