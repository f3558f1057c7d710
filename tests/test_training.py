"""The command line on a rendered recording: what a run prints and leaves, that it learns, and what it refuses."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
import warnings
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import warm
from commands import ROOT, SHORT, TINY, begun_training, log, python, refused, same, trained, weights
from PIL import Image
from rendered import render_recording
from steer_server import unused_port

import model
from cloning.base.errors import RecordingError, UserError
from cloning.network.compute import choose_device, placed
from cloning.training import options, pictures, summary
from cloning.training.checkpoint import Progress
from cloning.training.distributed import FirstRankFailed, Ranks
from cloning.training.lanes import Lanes, Poses
from cloning.training.options import FIGURES, ROBUST_ONLY, Process, Run, build_parser
from cloning.training.recipe import Recipe, option_name
from cloning.training.stop import status_of
from model import REPORT, ROBUST


def parse(argv):
    return options.parse(argv, REPORT, ROBUST)


def test_what_a_run_prints(finished, sample_recording):
    lines = finished[0].splitlines()
    counts = [line.split()[-4:] for line in lines if line.startswith((str(sample_recording), "total"))]
    assert counts == [["60", "0", "6", "54"]] * 2
    assert "Total params: 559,419" in lines
    assert sum(line.startswith("Epoch ") for line in lines) == 2
    epochs = [line for line in lines if "val_loss" in line]
    assert len(epochs) == 2
    assert all(re.match(r"[89]\d images \[={30}\] - \d+s - loss: ", line) for line in epochs)
    assert any("steer 0" in line and "model-best.pt" in line for line in lines)
    assert "nan" not in finished[0]
    assert lines[-2] == f"next: python drive.py '{finished[1] / 'model.pt'}'"
    assert lines[-1] == "`python model.py --robust` trains a network that drives better"


def test_a_run_tells_once_how_long_it_will_take_and_then_what_is_left(monkeypatch, capsys):
    """A batch of 100 images a second, 3 epochs of 3,000 images: 90 seconds in all."""
    now = 1000.0
    monkeypatch.setattr(summary, "time", Mock(monotonic=lambda: now))
    pace, progress = summary.Pace(replace(REPORT, epochs=3, samples_per_epoch=3000)), Progress()
    shown = []
    for _ in range(31):
        now, progress.images, progress.loss = now + 1, progress.images + 100, progress.loss + 10
        shown.append(pace.after_batch(100, progress))
    assert shown[0] == "loss: 0.1000" and shown[9] == "loss: 0.1000, 80 seconds left in all"
    progress.finish_epoch(0.1, math.nan)
    now, progress.images, progress.loss = now + 61, 6000, 600
    assert pace.after_batch(6000, progress) == "loss: 0.1000, 0 seconds left in all"
    assert capsys.readouterr().out == "about 89 seconds for 3 epochs on this machine\n"
    for seconds, words in ((89, "89 seconds"), (100, "2 minutes"), (5000, "83 minutes"), (9000, "2.5 hours")):
        assert summary.duration(seconds) == words


def test_a_resumed_run_tells_how_long_its_rest_will_take(monkeypatch, capsys):
    monkeypatch.setattr(summary, "time", Mock(monotonic=Mock(side_effect=map(float, range(100)))))
    pace, progress = summary.Pace(replace(REPORT, epochs=1, samples_per_epoch=10_000)), Progress(images=7000)
    for _ in range(12):
        progress.images += 100
        pace.after_batch(100, progress)
    assert capsys.readouterr().out == "about 29 seconds for the rest of 1 epoch on this machine\n"


def test_an_error_above_that_of_constant_steering_is_explained():
    labels = np.array([0.0] * 9 + [0.5], np.float32)

    def text(guess):
        return summary.error_table(labels, 0.05, {Path("my runs", "net.pt"): guess}, REPORT)

    larger = text(labels + np.float32(0.3))
    assert "larger error than steer 0, which is nearly right on straights.\n" in larger and "nan" not in larger
    assert larger.endswith(f"replay RECORDING --model '{Path('my runs', 'net.pt')}'")
    assert "larger error" not in text(labels) and "hardly follows" not in text(labels)
    long = summary.error_table(labels, 0.05, {Path("jungle-shadows.pt"): labels, Path("a.pt"): labels}, REPORT)
    title, *figures = [line for line in long.splitlines() if "  steer 0  " in line or line.startswith("steering of")]
    assert title.split()[-2:] == ["jungle-shadows.pt", "a.pt"] and {len(line) for line in figures} == {len(title)}
    assert "net.pt hardly follows the driver" in text(np.zeros_like(labels))
    with warnings.catch_warnings(action="error"):
        assert math.isnan(summary.correlation(labels[:1], labels[:1])), "of a single row"


def test_the_line_and_the_texts_of_a_diagnostic_picture_stay_within_it():
    for rows in (75, 160):
        for steering in (-1.0, 0.0, 1.0):
            texts = "2.0 m right, turned 25° right, underexposed:5", "brightness x 0.75"
            picture = np.asarray(pictures.panel(np.zeros((rows, 320, 3), np.uint8), texts[0], steering, texts[1]))
            yellow, caption = (picture == (255, 255, 0)).all(2).nonzero()[0], len(picture) - pictures.SCALE * rows
            assert caption < yellow.min() < yellow.max() < len(picture)
            assert (picture[:caption, -2:] == 255).all(), "the longest title ends before the picture"


def test_a_diagnostic_picture_names_the_pose_that_its_image_shows():
    """A car on a straight that is not turned steers away from the side on which it is, also in a mirrored image."""
    offset, mirrored = np.array([0.8, 0.8, -1.1, -1.1]), np.array([False, True, False, True])
    poses = Poses.of(Lanes.unknown(4), offset, np.zeros(4), np.zeros(4, int), mirrored)
    titles = [poses.title(at) for at in range(4)]
    assert [title.split(",")[0] for title in titles] == ["0.8 m right", "0.8 m left", "1.1 m left", "1.1 m right"]
    assert [" m right," in title for title in titles] == [steering < 0 for steering in poses.steering]
    turned = Poses.of(Lanes.unknown(2), np.zeros(2), np.radians([5, 5]), np.zeros(2, int), mirrored[:2])
    assert [turned.title(at) for at in range(2)] == [f"in the middle, turned 5° {side}" for side in ("right", "left")]
    assert titles[0].endswith(", not turned")


def test_what_a_run_leaves(finished):
    folder = finished[1]
    models = {"model.pt", "model-best.pt", "model-resume.pt", "diagnostic_images"}
    figures = {"training_loss.png", "training_log.csv", "training_arguments.json", "training_progress.json"}
    assert {path.name for path in folder.iterdir()} == models | figures
    rows = log(folder)
    assert [row["epoch"] for row in rows] == ["1", "2"]
    assert all(int(row["images"]) >= 80 and float(row["loss"]) > 0 < float(row["val_loss"]) for row in rows)
    assert json.loads((folder / "training_arguments.json").read_text(encoding="utf-8"))["recipe"]["batch_size"] == 8
    saved = torch.load(folder / "model.pt", weights_only=True)
    assert [row["epoch"] for row in saved["history"]] == [1, 2]
    best = min(rows, key=lambda row: float(row["val_loss"]))
    assert same(weights(folder / "model-best.pt"), weights(folder / "model.pt")) == (best["epoch"] == "2")
    for name in ("training_generator_LRC_0.png", "training_generator_augmented-0.png"):
        assert Image.open(folder / "diagnostic_images" / name).size[0] > 2 * 320


def test_training_learns(sample_recording, tmp_path):
    """After some seconds it predicts frames that it was not trained on ten times better than the mean steering."""
    faster = ("--learning-rate", 2e-3, "--samples-per-epoch", 1000, "--epochs", 1)  # measured: 29 times
    told = trained(sample_recording, *SHORT, *faster, "--output", tmp_path / "model.pt")
    steering = np.loadtxt(sample_recording / "driving_log.csv", delimiter=",", usecols=3)
    assert float(log(tmp_path)[-1]["val_loss"]) < 0.1 * steering.var()  # the error of steering the mean
    correlations = next(line.split()[-4:] for line in told.splitlines() if line.startswith("correlation"))
    assert float(correlations[2]) > 0.95
    assert "hardly follows" not in told


def test_a_run_trains_on_resampled_rows_and_validates_on_other_frames(sample_recording, tmp_path):
    run = begun_training(sample_recording, "--output", tmp_path / "m.pt")
    run.pool.shutdown()
    training, validation = run.generator.observations, run.validation
    rows = np.loadtxt(sample_recording / "driving_log.csv", delimiter=",", usecols=(3, 4))
    assert not set(training.frame) & set(validation.frame)
    used, driven = {*training.row, *validation.row}, set(np.flatnonzero(rows[:, 1]))  # throttle is 0 in the others
    assert used <= driven and all(abs(rows[row, 0]) < 0.02 for row in driven - used)
    assert len(validation) == len(set(validation.row)) < 0.35 * len(set(training.row))
    times = np.bincount(training.row, minlength=len(rows))[training.row]
    size = np.abs(rows[training.row, 0])
    assert set(times[(size > 0.2) & (size <= 0.5)]) == {2} and set(times[size < 0.2]) == {1}


def test_a_link_may_name_a_recording_a_problem_area(linked, tmp_path):
    link = tmp_path / "lake-repetitive"
    try:
        link.symlink_to(linked)
    except OSError:
        pytest.skip("Windows lets only privileged users make symbolic links")
    once, often = (
        model.prepare(parse([str(folder), "--output", str(tmp_path / "model.pt")])) for folder in (linked, link)
    )
    assert len(often.training) == 4 * len(once.training)
    assert often.run.recordings == (str(link),), "as --resume will read it"


def test_every_recording_under_data_is_the_default(linked, tmp_path):
    render_recording(linked.with_name("turn-repetitive"), rows=20, seed=1)
    told = trained(*TINY, cwd=tmp_path)
    assert next(line.split()[1] for line in told.splitlines() if line.startswith("total")) == "80"


# No SIGTERM, processor affinity, fork or mallopt, as on Windows or macOS, and no library of sockets.
ELSEWHERE = """
import ctypes, importlib.abc, os, signal, sys, torch

class TakenAway(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"eventlet", "engineio", "socketio", "flask", "wsproto"}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, TakenAway())
for module, name in ((signal, "SIGTERM"), (os, "sched_getaffinity"), (os, "fork")):
    vars(module).pop(name, None)
ctypes.CDLL = lambda name: object()
import cloning.network.network, cloning.network.attention, cloning.network.compute
import model, simulator.__main__ as simulator
recording, trained, *tiny = sys.argv[1:]
for recipe in ("--no-robust", "--robust"):
    assert model.main([recording, recipe, *tiny, "--output", trained]) == 0
assert not {"torch._dynamo", "sympy"} & set(sys.modules)  # torch's own optimizers load its compiler, for seconds
assert simulator.main(["replay", recording, "--model", trained, "--limit", "1", "--reference", "human"]) in (0, 1)
"""


def test_it_trains_and_replays_without_what_only_some_systems_have(sample_recording, tmp_path):
    command = [sys.executable, "-c", ELSEWHERE, sample_recording, tmp_path / "model.pt", *map(str, TINY)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "limit 1 m, from the " in done.stdout and "autonomy" in done.stdout


# ----------------------------------------------------------------------------------------------------------------------
# Invalid arguments and recordings


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["nowhere", "--output", "runs/a/model.pt"], "data/README.md"),
        (["data/lake/IMG"], "data/README.md"),
        (["--epochs", "0"], "--epochs"),
        (["--epochs", "30000"], "at most 20000"),
        (["--learning-rate", "nan"], "--learning-rate"),
        (["--side-correction", "100"], "100 is not a finite number of at least -1"),
        (["--seed", str(2**64)], "--seed"),
        (["--throttle-threshold", "2"], "--throttle-threshold drops"),
        (["--batch-size", str(10**18)], "at most"),
        (["--output", "training_progress.json"], "is named for two outputs"),
        (["--output", "runs/a/"], "error: --output runs/a/: is a folder"),
        (["--device", "cuda"], "error: --device cuda: "),
        (["--device", "mps"], "error: --device mps: "),
        (["--robust", "--throttle-threshold", "0.1"], "--throttle-threshold has no effect with --robust"),
        (["--robust", "--side-correction", "0.1"], "--side-correction has no effect with --robust"),
        (["--disturbed", "0.1"], "--disturbed has no effect without --robust"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_written(linked, tmp_path, monkeypatch, arguments, words):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    told = refused(*arguments, cwd=tmp_path)
    assert "model.py: " in told and words in told and "Traceback" not in told
    assert {path for path in tmp_path.rglob("*") if linked not in path.parents} == {linked.parent, linked}


def test_frames_that_are_in_two_recordings_are_told(sample_recording, tmp_path, capsys):
    """As those of a part that was exported: what is cut from one stays in the other."""
    parts = [shutil.copytree(sample_recording, tmp_path / name) for name in ("part", "an\x1bother")]
    with open(parts[1] / "driving_log.csv", "a") as log:
        log.write("no row\n")
    for others in (parts[:1], parts):
        model.read_observations(REPORT, [sample_recording, *others], False)
        told = capsys.readouterr().out
        assert "\n54 frames are in more than one of these recordings" in told and "\x1b" not in told
    assert "an\\x1bother/driving_log.csv: line 61: left out" in told
    model.read_observations(REPORT, [sample_recording], False)
    assert "more than one" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("process", "words"), [({"output": "runs/a/"}, "is a folder"), ({"device": "gpu"}, "finds no such GPU")]
)
def test_a_programs_arguments_are_checked_as_the_commands(linked, tmp_path, monkeypatch, capsys, process, words):
    monkeypatch.chdir(tmp_path)
    assert model.train(REPORT, [linked], **{"output": "model.pt", "device": "cpu"} | process) == 2
    assert words in capsys.readouterr().err and not (tmp_path / "runs").exists()


def test_numpys_numbers_make_a_run_that_can_be_saved(monkeypatch):
    monkeypatch.setattr(model, "execute", lambda command: command.run.seed)
    assert type(model.train(REPORT, ["data"], "model.pt", np.arange(2)[1])) is int
    epochs: Any = np.int64(3)
    turn, brightness = (np.float64(0.2), 0.5), np.array([0.4, 1.2])
    ranges: dict[str, Any] = {"turn": turn, "brightness": brightness}
    recipe = replace(REPORT, learning_rate=np.logspace(-4, -3, 2)[0], epochs=epochs, **ranges)
    assert {type(figure) for figure in (recipe.learning_rate, *recipe.turn, *recipe.brightness)} == {float}
    assert type(recipe.epochs) is int
    assert recipe == replace(REPORT, epochs=3) and REPORT.restored(recipe.saved()) == recipe
    whole = replace(REPORT, huber=1)
    assert whole.restored(whole.saved()) == whole
    with pytest.raises(ValueError, match="best_by is 'drift'"):
        replace(REPORT, best_by="drift")


def test_several_processes_leave_apples_gpu_alone_and_its_weights_are_contiguous(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert choose_device("auto").type == "mps"
    for device, layout in (("mps", torch.contiguous_format), ("cpu", torch.channels_last)):
        placed(network := Mock(), device)
        assert network.to.call_args.kwargs["memory_format"] == layout
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert choose_device("auto").type == "cpu"
    with pytest.raises(UserError, match="--device mps: several processes"):
        choose_device("mps")


def test_straight_rows_that_are_all_left_out_by_resampling(tmp_path):
    """Each stays with a probability of 0.8: with this seed none of four does."""
    log = render_recording(tmp_path / "straight", rows=5) / "driving_log.csv"
    log.write_text(re.sub(r",[^,]+(,1,0,30.19)", r",0\1", log.read_text(encoding="utf-8")), encoding="utf-8")
    assert "resampling has left out all rows for training" in refused(log.parent, "--seed", 198, cwd=tmp_path)


def test_why_too_few_rows_are_left(linked, tmp_path):
    short = render_recording(tmp_path / "short", rows=3)
    assert "3 of 3 rows are left, at least 5 are needed: record more\n" in refused(short, cwd=tmp_path)
    names = sorted(path.name for path in linked.glob("IMG/center*"))
    (linked / "excluded.csv").write_text(f"{names[0]},{names[-3]},\n", encoding="utf-8")
    assert "are left, at least 5 are needed: excluded.csv cuts most of them" in refused(linked, cwd=tmp_path)


def test_a_damaged_image_is_named_and_left_out_and_strict_stops(copied, tmp_path):
    damaged = sorted((copied / "IMG").glob("left*"))[3]
    damaged.write_bytes(damaged.read_bytes()[:1000])
    told = trained(copied, *TINY, "--output", tmp_path / "model.pt")
    assert f"line 4: left out: IMG/{damaged.name}: cut short" in told and "\n1 unusable line left out" in told
    header, row = (tmp_path / "rejected_rows.csv").read_text(encoding="utf-8").splitlines()
    assert header == "file,line,finding,detail" and damaged.name in row
    summary.list_rejected([], tmp_path / "rejected_rows.csv")
    assert not (tmp_path / "rejected_rows.csv").exists(), "an earlier run's list is not this one's"
    assert damaged.name in refused(copied, *SHORT, "--strict", "--output", tmp_path / "strict.pt")
    assert not (tmp_path / "strict.pt").exists()


def test_a_given_value_counts_as_given_also_when_it_is_the_default():
    resumed = parse(["--resume", "--epochs", "10"])
    assert (resumed.run, resumed.process) == (Run(REPORT), Process(resume=True))
    assert resumed.given == {"resume", "epochs"}
    assert parse([]).run == Run(REPORT) and not parse([]).given
    assert parse(["data"]).given == {"recordings"}
    assert parse(["a", "--epochs", "3", "b"]).run.recordings == ("a", "b"), "they may follow options"


def test_options_are_fields_of_the_recipe_the_run_and_the_process():
    """And the recipe of --robust is the report's but for what it names."""
    actions = build_parser(REPORT, ROBUST)._actions
    names = {field.name for each in (Recipe, Run, Process) for field in fields(each)}
    assert {action.dest for action in actions} - {"help", "robust"} <= names
    for name in FIGURES:
        value: Any = {"epochs": 3, "batch_size": 5, "samples_per_epoch": 7, "repeats": 2}.get(name, 0.5)
        recipe, *robust = (ROBUST, "--robust") if name in ROBUST_ONLY else (REPORT,)
        assert parse([*robust, option_name(name), str(value)]).run.recipe == replace(recipe, **{name: value})
    assert parse(["--robust", "--epochs", "1"]).run.recipe == replace(ROBUST, epochs=1)


def test_importing_does_nothing(tmp_path):
    code = "import model, cloning.recordings.log, cloning.network.network"
    done = python("-c", code, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not os.listdir(tmp_path)


# ----------------------------------------------------------------------------------------------------------------------
# Several processes

TORCHRUN = ("-m", "torch.distributed.run", "--nproc_per_node=2", "--master_port=0", "--standalone", ROOT / "model.py")


def assert_equal_up_to_rounding(one: Path, other: Path) -> None:
    """Adam moves a weight by up to 1e-4 a step, of which there were 6 or more."""
    a, b = weights(one), weights(other)
    for name in a:
        assert (a[name] - b[name]).abs().mean() < 2e-6


@pytest.mark.skipif(sys.platform == "win32", reason="PyTorch for Windows has no libuv for torchrun")
def test_two_processes_train_and_go_on_as_one(finished, sample_recording, tmp_path):
    """Two ranks with half of every batch each end where one process ends; they print once, and the losses of both."""
    one, two = shutil.copytree(finished[1], tmp_path / "one") / "model.pt", tmp_path / "two" / "model.pt"
    done = python(*TORCHRUN, sample_recording, *SHORT, "--output", two)
    assert done.returncode == 0, done.stderr
    assert_equal_up_to_rounding(one, two)
    losses, of_both = (
        [float(loss) for line in told.splitlines() for loss in re.findall(r"loss: ([\d.]+)", line)]
        for told in (finished[0], done.stdout)
    )
    assert len(losses) == 4 and of_both == pytest.approx(losses, abs=2e-4)  # the global losses; bfloat16 rounds

    more = ("--resume", "--epochs", 3)  # with the run's own arguments, and in processes as torchrun starts them
    trained("--output", one, *more)
    environment = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(unused_port())}
    command = [sys.executable, str(ROOT / "model.py"), "--output", str(two), *map(str, more)]
    ranks = [warm.Popen(command, env={**os.environ, **environment, "RANK": str(rank)}) for rank in range(2)]
    assert [rank.wait(300) for rank in ranks] == [0, 0]
    assert [row["epoch"] for row in log(two.parent)] == ["1", "2", "3"]
    assert_equal_up_to_rounding(one, two)


def test_a_rank_prints_the_error_that_it_alone_meets(tmp_path, capsys):
    """And not the one that rank 0 meets, which prints it."""
    own = RecordingError("1.jpg: cut short")
    for error, printed in ((own, "python: 1.jpg: cut short\n"), (FirstRankFailed(), "")):
        ranks = Ranks(rank=1)
        status = status_of(Mock(side_effect=error), Process(str(tmp_path / "model.pt")), ranks)
        assert (status, capsys.readouterr().err) == (2, printed)


def test_the_losses_within_the_epochs_stay_few_in_a_long_run():
    progress = Progress()
    for number in range(1, 25_001):
        progress.add(8, 8 * 0.001 * number)
        assert len(progress.trail) == number // progress.trail_every < 2000
    assert progress.trail_every == 20
    batches = np.arange(1, 1251) * 20
    np.testing.assert_allclose(progress.trail[50:], 0.001 * (batches[50:] - 9), rtol=1e-3)  # 9 batches behind
