"""Does a network's loss tell how it drives? Train networks that differ as people's do, and measure each in three ways.

    python -m tools.study data                   # 71 networks: one to two hours on 2 cores
    python -m tools.study data --networks 2 --images 200 --laps 0.1 --starts 2  # a trial

`data` holds real recordings by the names lake-ccw, lake-cw, jungle and jungle-shadows (data/README.md says where they
are from). The networks are trained on lake-ccw or jungle, some on both or on a lap in the stand-in simulator;
lake-cw and jungle-shadows are held out. Each network is measured by its errors on the held-out recording (what a loss
is made of), by replays of that recording, and by laps in the stand-in simulator, which stand for driving. Some are also
started next to the lane, and turned: do they come back?

The folder then holds study.csv, a row for each network, study.md with the rank correlations of all measures with
driving, and pictures. An interrupted study continues when it is started again with the same options.
"""

import argparse
import csv
import io
import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("study")  # also while the libraries below are loaded

from cloning.base.arguments import number
from cloning.base.cores import threads
from cloning.base.errors import RecordingError, UserError
from cloning.base.outputs import write_json, write_output
from cloning.recordings.format import DRIVING_LOG
from cloning.road.track import Track
from simulator.record import record
from tools.study.figures import Row, correlation_picture, recovery_picture, report, row
from tools.study.network import RESULT
from tools.study.networks import EPOCH_IMAGES, RENDERED, TRACKS, Variant, plan

ROOT = Path(__file__).resolve().parent.parent.parent


def prepare(options: argparse.Namespace) -> None:
    """Check the recordings, and render the one that is rendered. Raises UserError, OSError."""
    names = sorted({name for track in TRACKS.values() for name in (track.train, track.held_out)})
    for name in names:
        if not (options.recordings / name / DRIVING_LOG).exists():
            raise RecordingError(
                f"{options.recordings / name}: the study needs recordings by the names {', '.join(names)}"
            )
    options.folder.mkdir(parents=True, exist_ok=True)
    file = options.folder / "options.json"
    began = {"images": options.images, "laps": options.laps, "starts": options.starts}
    if file.exists() and json.loads(file.read_text(encoding="utf-8")) != began:
        raise UserError(f"{file}: the study began with other options; give these, or another --folder")
    write_json(file, began)
    rendered = options.folder / RENDERED
    if not rendered.exists():
        unfinished = rendered.with_name(f"unfinished-{RENDERED}")
        shutil.rmtree(unfinished, ignore_errors=True)
        record(unfinished, Track("lake"), options.laps)
        unfinished.rename(rendered)


def result(variant: Variant, options: argparse.Namespace) -> dict[str, float]:
    """Return a network's measures; train and measure it first if that is still to be done. Raises UserError."""
    folder = options.folder / variant.name
    file = folder / RESULT
    if not file.exists():
        command = [variant.name, options.recordings, folder, options.images, options.laps, options.starts]
        done = subprocess.run(
            [sys.executable, "-m", "tools.study.network", *map(str, command)], cwd=ROOT, capture_output=True, text=True
        )
        if done.returncode:
            raise UserError(f"{folder}: status {done.returncode}: {done.stderr.strip()[-500:]}")
        print(f"{variant.name} is measured", flush=True)
    return json.loads(file.read_text(encoding="utf-8"))


def write_study(rows: list[Row], folder: Path) -> None:
    """Write the table, the report and the pictures of the networks measured so far. Raises OutputError."""
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_output(folder / "study.csv", text.getvalue().encode())
    write_output(folder / "study.md", report(rows).encode())
    for picture in (correlation_picture, recovery_picture):
        write_output(folder / f"study_{picture.__name__.removesuffix('_picture')}.png", picture(rows))


def main(argv: list[str] | None = None) -> int:
    """Train and measure all networks that are not measured yet, and write the study; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="study", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, help="the folder of the real recordings")
    parser.add_argument("--networks", type=number(int, 1), help="measure only the first ones of the plan")
    parser.add_argument("--images", type=number(int, 1), default=EPOCH_IMAGES, help="in an epoch (default %(default)s)")
    parser.add_argument(
        "--laps", type=number(float, 0.01, 100), default=1, help="in each direction (default %(default)s)"
    )
    parser.add_argument("--starts", type=number(int, 1), default=24, help="of the recovery (default %(default)s)")
    parser.add_argument(
        "--jobs", type=number(int, 1), default=threads(), help="networks at a time (default: one for each core)"
    )
    parser.add_argument("--folder", type=Path, default=Path("study"), help="where to write (default %(default)s)")
    options = parser.parse_args(argv)
    options.folder = options.folder.resolve()  # the networks' processes run in another folder
    options.recordings = options.recordings.resolve()
    variants = plan()[: options.networks]
    try:
        prepare(options)
        with ThreadPoolExecutor(options.jobs) as pool:
            try:
                results = list(pool.map(partial(result, options=options), variants))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        write_study([row(variant, found) for variant, found in zip(variants, results, strict=True)], options.folder)
    except (UserError, OSError) as error:
        return program.failed("study", error)
    print(f"{options.folder / 'study.md'}, study.csv and pictures")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
