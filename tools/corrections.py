"""Measure what corrections are worth: departures per lap, beside a network that learns from as many additional laps.

    python -m tools.corrections --laps 1 --seeds 0 1 2     # the jungle at 15 mph: about two hours on 2 cores
    python -m tools.corrections --track road-1001 --rounds 1 --seeds 0 --epochs 1 --more-epochs 1

This is the figure of DAgger (Ross et al. 2011, arXiv 1011.0686) in the stand-in simulator. For each seed, the recipe's
network is trained on the expert's laps and drives a lap. Then, in each round, either it drives a lap with the expert's
corrections, which are added to the recordings, or the expert drives one more lap, which is added. The network of the
round before is trained on, with --from, on all recordings so far, and drives a lap again, until it drives one without a
departure. Both kinds of round have the same number of epochs, of the same number of images. To train on costs half of
training anew, and alike for both.

The folder then holds departures.csv, departures.png and all recordings and networks. An interrupted measurement
continues when it is started again with the same options.
"""

import argparse
import csv
import io
import json
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from cloning.base import program

if __name__ == "__main__":
    program.end_on_interrupt("corrections")  # also while the libraries below are loaded

from cloning.base.arguments import number
from cloning.base.errors import UserError
from cloning.base.outputs import write_json, write_output
from cloning.recordings.format import DRIVING_LOG, PROBLEM_AREAS
from cloning.road.motion import TOP_SPEED_MPH
from cloning.road.track import Track
from simulator.record import record
from tools.scoreboard import drive_laps, serving

ROOT = Path(__file__).resolve().parent.parent
START, CORRECTIONS, LAPS = "start", "corrections", "laps"  # the first network, and the two kinds of rounds
COLOURS = {CORRECTIONS: "tab:blue", LAPS: "tab:orange"}


class Measured(NamedTuple):
    """A network's lap: a row of departures.csv.

    seed            of the training, and of the expert's laps
    kind            START, or the kind of the rounds that led to it, CORRECTIONS or LAPS
    round           from 0, which is START
    laps            driven for its recordings
    rows            of its recordings
    departures      per lap, at least 1 if the car stood still
    offset_mean_m   mean distance from the lane's centre
    record_seconds  for this round's recording
    train_seconds   for this round's training
    """

    seed: int
    kind: str
    round: int
    laps: float
    rows: int
    departures: float
    offset_mean_m: float
    record_seconds: float
    train_seconds: float


class Measurement:
    """The measurement in a folder, whose results are kept after each round."""

    def __init__(self, args: argparse.Namespace):
        """Read the earlier results. Raises UserError if the folder was begun with other options, OSError."""
        self.args, self.folder = args, args.folder.resolve()  # the simulator runs in another folder
        self.track, self.results = Track(args.track), []
        self.table = self.folder / "departures.csv"
        options = {name: value for name, value in vars(args).items() if name not in ("folder", "rounds", "seeds")}
        file = self.folder / "options.json"
        self.folder.mkdir(parents=True, exist_ok=True)
        if file.exists() and json.loads(file.read_text(encoding="utf-8")) != options:
            raise UserError(f"{file}: the measurement began with other options; give these, or another --folder")
        write_json(file, options)
        if self.table.exists():
            with open(self.table, encoding="utf-8", newline="") as opened:
                for row in csv.DictReader(opened):
                    types = Measured.__annotations__.items()
                    self.results.append(Measured(**{name: kind(row[name]) for name, kind in types}))

    def run(self) -> None:
        """Measure what is not measured yet. Raises UserError, OSError."""
        for seed in self.args.seeds:
            for kind in (CORRECTIONS, LAPS):
                last = self.measured(seed, START, 0)
                for round_number in range(1, self.args.rounds + 1):
                    if last.departures:
                        last = self.measured(seed, kind, round_number)

    def measured(self, seed: int, kind: str, round_number: int) -> Measured:
        """Return the result of a round; record, train and drive if there is none yet."""
        for result in self.results:
            if result[:3] == (seed, kind, round_number):
                return result
        begin = time.perf_counter()
        recording = self.recording(seed, kind, round_number)
        if not recording.exists():
            self.record(recording, seed, kind, round_number)
        recorded = time.perf_counter()
        recordings = [self.recording(seed, START, 0)]
        recordings += [self.recording(seed, kind, n) for n in range(1, round_number + 1)]
        recordings = [folder for folder in recordings if (folder / DRIVING_LOG).exists()]
        model = self.train(recordings, seed, kind, round_number)
        trained = time.perf_counter()
        with serving(model, self.args.speed, 1) as ports:
            place = self.args.track, self.track.direction, self.args.look
            drive = drive_laps(ports, self.args.speed, 1, place)
        rows = sum((folder / DRIVING_LOG).read_bytes().count(b"\n") for folder in recordings)
        result = Measured(
            seed,
            kind,
            round_number,
            self.args.laps + round_number,
            rows,
            max(drive["departures"], drive["laps_with_departure"]) / drive["laps"],
            drive["offset_mean_m"],
            round(recorded - begin, 1),
            round(trained - recorded, 1),
        )
        self.results.append(result)
        self.write()
        seconds = f"{recorded - begin:.0f} s recording, {trained - recorded:.0f} s training"
        print(
            f"seed {seed}, {kind} {round_number}: {result.departures:g} departures a lap, {rows} rows; "
            f"{seconds}, {time.perf_counter() - trained:.0f} s driving",
            flush=True,
        )
        return result

    def place(self, seed: int, kind: str) -> Path:
        """Return the folder of the rounds of a kind."""
        return self.folder / f"seed-{seed}" / kind

    def recording(self, seed: int, kind: str, round_number: int) -> Path:
        """Return the folder of a round's recording, which need not exist."""
        ending = PROBLEM_AREAS[-1] if kind == CORRECTIONS else ""
        return self.place(seed, kind) / f"{self.args.track}-{round_number}{ending}"

    def model(self, seed: int, kind: str, round_number: int) -> Path:
        """Return the file of a round's network, which need not exist."""
        return self.place(seed, kind if round_number else START) / f"round-{round_number}" / "model.pt"

    def record(self, folder: Path, seed: int, kind: str, round_number: int) -> None:
        """Record the expert's laps, or its corrections of the network of the round before. Raises UserError."""
        unfinished = folder.with_name(f"unfinished-{folder.name}")
        shutil.rmtree(unfinished, ignore_errors=True)
        args = self.args
        if kind != CORRECTIONS:
            laps = 1 if round_number else args.laps
            record(unfinished, self.track, laps, args.speed, seed=100 * seed + round_number, look=args.look)
        else:
            with serving(self.model(seed, kind, round_number - 1), args.speed, 1) as ports:
                command = ["correct", unfinished, "--track", args.track, "--laps", 1, "--speed", args.speed]
                command += ["--look", args.look, "--port", ports.get()]
                done = subprocess.run(
                    [sys.executable, "-m", "simulator", *map(str, command)], cwd=ROOT, capture_output=True, text=True
                )
            if done.returncode == program.FAILED:
                raise UserError(f"{folder}: {done.stderr}")
            unfinished.mkdir(exist_ok=True)  # nothing was corrected
        unfinished.rename(folder)

    def train(self, recordings: list[Path], seed: int, kind: str, round_number: int) -> Path:
        """Train a round's network, or go on training it, and return its file. Raises UserError."""
        args, model = self.args, self.model(seed, kind, round_number)
        epochs = args.more_epochs if round_number else args.epochs
        command = [*recordings, "--output", model, "--resume", "--seed", seed, "--epochs", epochs]
        command += ["--samples-per-epoch", args.samples_per_epoch]
        if round_number:
            command += ["--from", self.model(seed, kind, round_number - 1)]
        model.parent.mkdir(parents=True, exist_ok=True)
        done = subprocess.run([sys.executable, ROOT / "model.py", *map(str, command)], stdout=subprocess.DEVNULL)
        if done.returncode:
            raise UserError(f"{model}: the training ended with status {done.returncode}")
        return model

    def write(self) -> None:
        """Write the table and the picture. Raises OutputError."""
        text = io.StringIO(newline="")
        rows = csv.writer(text, lineterminator="\n")
        rows.writerows([Measured._fields, *self.results])
        write_output(self.table, text.getvalue().encode())
        write_output(self.folder / "departures.png", picture(self.results, self.args.track))


def by_seed(results: list[Measured], kind: str) -> dict[int, list[Measured]]:
    """Return the results of each seed that has rounds of a kind, in the order of the rounds, from START on."""
    seeds = {result.seed for result in results if result.kind in (START, kind)}
    rounds = sorted((result for result in results if result.kind in (START, kind)), key=lambda result: result.round)
    return {seed: [result for result in rounds if result.seed == seed] for seed in sorted(seeds)}


def means(results: list[Measured], kind: str) -> list[tuple[float, float]]:
    """Return the mean of the seeds' departures per lap by the number of laps; a seed that has ended keeps its last."""
    seeds = list(by_seed(results, kind).values())
    longest = max(seeds, key=len, default=[])
    return [
        (result.laps, statistics.mean(rounds[min(n, len(rounds) - 1)].departures for rounds in seeds))
        for n, result in enumerate(longest)
    ]


def picture(results: list[Measured], track: str) -> bytes:
    """Return a plot of departures per lap against laps, as PNG: a thin line for each seed, a thick one for the mean."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # here, because loading matplotlib takes long
    from matplotlib.figure import Figure
    from matplotlib.ticker import MultipleLocator

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for kind, colour in COLOURS.items():
        for rounds in by_seed(results, kind).values():
            axes.plot([r.laps for r in rounds], [r.departures for r in rounds], color=colour, linewidth=0.7, alpha=0.6)
        axes.plot(*zip(*means(results, kind), strict=True), "o-", color=colour, label=kind)
    axes.set(xlabel="laps driven for recordings", ylabel="departures per lap", title=f"{track}: seeds, and their mean")
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_locator(MultipleLocator(1))
    axes.legend()
    png = io.BytesIO()
    figure.savefig(png, format="png", dpi=150)
    return png.getvalue()


def main(argv: list[str] | None = None) -> int:
    """Measure, and print the mean of the seeds; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="corrections", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--track", default="jungle", help="as of `simulator record` (default %(default)s)")
    parser.add_argument("--look", type=number(int, 0), default=0, help="of the track (default %(default)s)")
    parser.add_argument(
        "--speed", type=number(int, 1, TOP_SPEED_MPH), default=15, help="set speed in mph (default %(default)s)"
    )
    parser.add_argument(
        "--laps", type=number(float, 0.01, 100), default=1, help="the expert's laps at the start (default %(default)s)"
    )
    parser.add_argument("--rounds", type=number(int, 1, 100), default=5, help="at most (default %(default)s)")
    parser.add_argument(
        "--seeds", type=number(int, 0, 10**6), nargs="+", default=[0, 1, 2], help="a measurement each (default 0 1 2)"
    )
    parser.add_argument("--epochs", type=number(int, 1), default=10, help="at the start (default %(default)s)")
    parser.add_argument("--more-epochs", type=number(int, 1), default=5, help="in each round (default %(default)s)")
    parser.add_argument(
        "--samples-per-epoch", type=number(int, 1), default=20224, help="as of model.py (default %(default)s)"
    )
    parser.add_argument("--folder", type=Path, default=Path("corrections"), help="where to write (default %(default)s)")
    args = parser.parse_args(argv)
    try:
        measurement = Measurement(args)
        measurement.run()
    except (UserError, OSError) as error:
        return program.failed("corrections", error)
    for kind in COLOURS:
        for laps, departures in means(measurement.results, kind):
            print(f"{kind:12} {laps:5g} laps driven: {departures:.2f} departures per lap")
    print(f"{measurement.table}, departures.png")
    return program.DONE


if __name__ == "__main__":
    program.run(main)
