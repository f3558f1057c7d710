"""The command `python -m simulator replay`: a model drives real recordings."""

import argparse
import contextlib
import functools
import multiprocessing
import signal
import sys
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path

import cv2

from cloning.base.errors import SimulatorError, UserError
from cloning.base.outputs import check_folders, run_all, short_names, write_json, write_output
from cloning.base.processes import starting
from cloning.base.progress import progress_bar
from cloning.recordings.format import DRIVING_LOG
from cloning.recordings.log import Recording, find_folders
from cloning.replay.replay import (
    Drive,
    Driver,
    LineDrive,
    NothingToReplay,
    ReferenceLine,
    ReplayFrame,
    Watcher,
    load_recording,
    reference_lines,
)
from cloning.replay.score import Metrics, ReplayFilm, plot, replay_report, report_text
from cloning.road.disturbances import Disturbance

CAN_FORK = sys.platform == "linux"  # elsewhere there is no fork, or libraries do not survive it


def run(options: argparse.Namespace, driver: Driver | None = None) -> None:
    """Replay the recordings at each limit, print their reports and write the files. Raises UserError.

    Those of which nothing can be replayed are named and left out, unless that is true of all.
    options: those of the command, under their names; driver: what drives in place of their model. After an error or
    Ctrl-C, the files are still written, with the recordings replayed until then.
    """
    folders = find_folders(options.folders)
    read = [options.model, *(folder / DRIVING_LOG for folder in folders)]
    check_folders(options.report, options.picture, options.film, read=read)
    ending: list[Callable[[], object]] = []
    if options.model and not driver:  # each driver needs a library of its own, PyTorch or wsproto
        from cloning.network.compute import one_thread
        from cloning.replay.model_driver import ModelDriver

        one_thread()  # other drives run at the same time
        driver = ModelDriver(options.model)
    elif not driver:
        from cloning.replay.server_driver import ServerDriver

        driver = server = ServerDriver(options.host, options.port, options.wait)
        ending.append(server.close)
    limits = list(dict.fromkeys(options.limits))  # each once
    film = ReplayFilm(options.film) if options.film else None
    reports: list[Metrics] = []

    def replay_all() -> None:
        for folder, name in zip(folders, short_names(folders), strict=True):
            try:
                recording = load_recording(folder)
                lines = reference_lines(recording, options.reference == "lane")
            except NothingToReplay as error:
                if folder == folders[-1] and not reports:
                    raise
                print(f"left out: {error}", flush=True)
                continue
            if film:
                film.begin(recording)
            watch = film.watch if film else None
            drives = drive_at_limits(recording, lines, driver, limits, watch, bool(options.model), options.disturb)
            disturbed = options.disturb and str(options.disturb)
            reports.append(replay_report(recording, lines, drives, options.reference, disturbed))
            print(report_text(reports[-1]), flush=True)
            if options.picture:
                path = Path(options.picture)
                if len(folders) > 1:
                    path = path.with_stem(f"{path.stem}-{name.replace('/', '-')}")
                write_output(path, plot(recording, drives))

    if film:
        ending.append(film.close)
    if options.report:
        ending.append(lambda: write_json(options.report, reports) if reports else None)
    run_all(replay_all, *ending)


def drive_at_limits(
    recording: Recording,
    lines: list[ReferenceLine],
    driver: Driver,
    limits: Sequence[float],
    watch: Watcher | None = None,
    parallel: bool = False,
    disturbance: Disturbance | None = None,
) -> list[Drive]:
    """Return the drives of a recording at each limit, in this order; see `LineDrive`.

    watch: of the drive at the last limit, called after each row, or None. parallel: on Linux, those that part from the
    last one go on in processes of their own; else they are driven anew along the line, one after the other. The driver
    must not learn from one drive anything that it needs in another. disturbance: see `drive`. If one drive fails, or on
    Ctrl-C, the others are ended. Raises what a drive raises, and SimulatorError if its process was killed.
    """
    if parallel := parallel and CAN_FORK:
        cv2.setNumThreads(1)  # its threads do not survive a fork, and the other drives need the cores
    drives = {limit: Drive(limit) for limit in limits}

    def drive_along(number: int, line: ReferenceLine) -> None:
        begin = functools.partial(LineDrive, recording, line, driver, disturbance, number)
        here, anew, before = begin(), list[Drive](), len(drives[limits[-1]].row)  # rows, of the lines before
        with ForkedDrives(drives) as forked:

            def after_row(frame: ReplayFrame, done: Drive) -> None:
                bar.update()
                forked.collect(0)
                if watch:
                    watch(frame, done)

            part = functools.partial(forked.start, here) if parallel else anew.extend
            here.go_on([*drives.values()], after_row, part)
            for done in anew:
                done.cut(before)
                begin().go_on([done], lambda *_: bar.update())
            forked.collect(None)

    with progress_bar(sum(len(line.stretch) for line in lines), "row", desc=recording.folder.name, leave=False) as bar:
        for number, line in enumerate(lines):
            drive_along(number, line)
    return [drives[limit] for limit in limits]


class ForkedDrives(contextlib.ExitStack):
    """Drives that go on in forked processes, one each: in threads, they would wait for one another's Python code.

    It is a context, at whose end none of them runs any more.
    """

    def __init__(self, drives: dict[float, Drive]):
        """drives: by their limits; each that was started is replaced when it has ended."""
        super().__init__()
        self.drives = drives
        self.pending: list[Connection] = []  # where results will come from

    def start(self, line: LineDrive, drives: Sequence[Drive]) -> None:
        """Let drives go on to the end of a line; what that changes in memory is lost, but for the Drives themselves."""
        context = multiprocessing.get_context("fork")
        for done in drives:
            receiver, sender = context.Pipe(duplex=False)
            with starting():
                process = context.Process(target=_go_on, args=(line, done, sender), daemon=True)
                process.start()
                self.callback(process.join)
                self.callback(process.terminate)  # first
            sender.close()
            self.pending.append(receiver)

    def collect(self, timeout: float | None) -> None:
        """Take the results that have come, and wait for the others: for the next one so many seconds, None: for all.

        Raises the UserError of a drive that failed, and SimulatorError if its process ended without a result.
        """
        while self.pending and (ready := wait(self.pending, timeout)):
            for receiver in ready:
                assert isinstance(receiver, Connection)
                try:
                    result = receiver.recv()
                except EOFError:
                    raise SimulatorError("the process of a drive was killed, or failed with the error above") from None
                if isinstance(result, UserError):
                    raise result
                self.drives[result.limit] = result
                self.pending.remove(receiver)


def _go_on(line: LineDrive, done: Drive, sender: Connection) -> None:
    """Drive to the line's end, and send the Drive, or the UserError that ends it."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        line.go_on([done])
        sender.send(done)
    except UserError as error:
        sender.send(error)
