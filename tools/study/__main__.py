"""Does a network's loss tell how it drives? Train networks that differ as people's do, and measure each in three ways.

    python -m tools.study data                   # 71 networks: one to two hours on 2 cores
    python -m tools.study data --networks 2 --images 200 --laps 0.1 --starts 2  # a trial

`data` holds real recordings by the names lake-ccw, lake-cw, jungle and jungle-shadows (data/README.md says where they
are from). The networks are trained on lake-ccw or jungle, some on both or on a lap in the stand-in simulator;
lake-cw and jungle-shadows are held out. Each network is measured by its errors on the held-out recording (what a loss
is made of), by replays of that recording, and by laps in the stand-in simulator, which stand for driving. Some are also
started next to the lane, and turned: do they come back?

The folder then holds study.csv, a row for each network, study.md with the rank correlations of all measures with
driving, and a picture of these. An interrupted study continues when it is started again with the same options.
"""

import argparse
import multiprocessing
import shutil
import signal
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path

from cloning.base import program
from cloning.base.arguments import command_line, number
from cloning.base.cores import threads
from cloning.base.errors import RecordingError, UserError
from cloning.base.files import csv_bytes
from cloning.base.outputs import claimed, read_json, write_json, write_output
from cloning.recordings.format import DRIVING_LOG
from cloning.road.track import Track
from simulator.record import record
from simulator.workers import begin
from tools.study.figures import correlation_picture, report, row
from tools.study.measures import measure
from tools.study.networks import EPOCH_IMAGES, RENDERED, TRACKS, Variant, plan


def check_recordings(folder: Path) -> None:
    """Raise RecordingError if a folder lacks one of the study's recordings."""
    names = sorted({name for track in TRACKS.values() for name in (track.train, track.held_out)})
    for name in names:
        if not (folder / name / DRIVING_LOG).exists():
            raise RecordingError(f"{folder / name}: the study needs recordings by the names {', '.join(names)}")


def prepare(options: argparse.Namespace) -> None:
    """Check the options against those with which the study began, and render a recording. Raises UserError, OSError."""
    file = options.folder / "options.json"
    began = {"images": options.images, "laps": options.laps, "starts": options.starts}
    if file.exists() and read_json(file) != began:
        raise UserError(f"{file}: the study began with other options; give these, or another --folder")
    write_json(file, began)
    rendered = options.folder / RENDERED
    if not rendered.exists():
        unfinished = rendered.with_name(f"unfinished-{RENDERED}")
        shutil.rmtree(unfinished, ignore_errors=True)
        record(unfinished, Track("lake"), options.laps)
        unfinished.rename(rendered)


def result(variant: Variant, options: argparse.Namespace) -> dict[str, float]:
    """Return a network's measures, made in a process of its own if there are none yet. Raises UserError, OSError."""
    file = options.folder / variant.name / "result.json"
    if not file.exists():
        context = multiprocessing.get_context("spawn")
        default = (signal.SIG_DFL,)  # Ctrl-C ends it at once, or saves its training
        with ProcessPoolExecutor(1, context, begin, default) as process:
            figures = options.images, options.laps, options.starts
            try:
                process.submit(measure, variant, options.recordings, file, *figures).result()
            except BrokenExecutor:
                remedy = "start the study again, with fewer --jobs"
                raise UserError(f"{file.parent}: its process was killed; {remedy}") from None
    return read_json(file)


def main(argv: list[str] | None = None) -> int:
    """Measure all networks and write the study; return the exit status. Raises UserError, OSError."""
    parser = command_line("python -m tools.study", __doc__)
    add = parser.add_argument
    add("recordings", type=Path, help="the folder of the real recordings")
    add("--networks", type=number(int, 1), help="measure only the first ones of the plan")
    add("--images", type=number(int, 1), default=EPOCH_IMAGES, help="in an epoch (default %(default)s)")
    add("--laps", type=number(float, 0.01, 100), default=1, help="in each direction (default %(default)s)")
    add("--starts", type=number(int, 1), default=24, help="of the recovery (default %(default)s)")
    add("--jobs", type=number(int, 1), default=threads(), help="networks at a time (default: one for each core)")
    add("--folder", type=Path, default=Path("study"), help="where to write (default %(default)s)")
    options = parser.parse_args(argv)
    variants = plan()[: options.networks]
    check_recordings(options.recordings)
    with claimed(options.folder):
        prepare(options)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # at once: its networks' processes end with it
        with ThreadPoolExecutor(options.jobs) as pool:
            try:
                found = list(pool.map(partial(result, options=options), variants))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        rows, study = [row(*pair) for pair in zip(variants, found, strict=True)], options.folder / "study.md"
        write_output(study.with_suffix(".csv"), csv_bytes([rows[0], *(network.values() for network in rows)]))
        write_output(study, report(rows).encode())
        write_output(study.with_name("study_correlation.png"), correlation_picture(rows))
    print(f"{study}, study.csv and study_correlation.png")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
