"""The command line on a drawn recording: what it leaves, and that nothing is ever lost."""

import csv
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time

import pytest
import torch
from conftest import ROOT, SHORT, draw_recording, finished_run, run_model, weights
from PIL import Image

import model

# The same command, but it saves after every batch: kills then strike at every place of an epoch, and while writing.
SAVING = [
    sys.executable,
    "-c",
    f"import sys; sys.path.insert(0, {str(ROOT)!r}); import model; model.SAVE_SECONDS = 0; sys.exit(model.main())",
]


def log(folder):
    with open(folder / "training_log.csv") as file:
        return list(csv.DictReader(file))


def same(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)


@pytest.fixture(scope="module")
def finished(drawn, tmp_path_factory):
    return finished_run(drawn, tmp_path_factory.mktemp("run"), *SHORT)


def test_what_a_run_prints(finished, drawn):
    lines = finished[0].stdout.splitlines()
    counts = [line.split()[-4:] for line in lines if line.startswith((str(drawn), "total"))]
    assert counts == [["60", "0", "6", "54"]] * 2
    assert "Total params: 559,419" in lines
    assert sum(line.startswith("Epoch ") for line in lines) == 2
    epochs = [line for line in lines if "val_loss" in line]
    assert len(epochs) == 2
    assert all("/150 [==============================] - " in line for line in epochs)
    assert any("steer 0" in line and "model-best.pt" in line for line in lines)


def test_what_a_run_leaves(finished):
    folder = finished[1]
    assert {path.name for path in folder.iterdir()} == {
        "model.pt",
        "model-best.pt",
        "model-resume.pt",
        "training_loss.png",
        "training_log.csv",
        "training_arguments.json",
        "diagnostic_images",
    }
    rows = log(folder)
    assert [row["epoch"] for row in rows] == ["1", "2"]
    assert all(int(row["images"]) >= 150 and float(row["loss"]) > 0 < float(row["val_loss"]) for row in rows)
    assert json.loads((folder / "training_arguments.json").read_text())["batch_size"] == 8
    saved = torch.load(folder / "model.pt", weights_only=True)
    assert [row["epoch"] for row in saved["history"]] == [1, 2]
    best = min(rows, key=lambda row: float(row["val_loss"]))
    assert same(weights(folder / "model-best.pt"), weights(folder / "model.pt")) == (best["epoch"] == "2")
    for name in ("training_generator_LRC_0.png", "training_generator_augmented-0.png"):
        assert Image.open(folder / "diagnostic_images" / name).size[0] > 1000


def test_same_seed_same_weights_other_seed_others(finished, drawn, tmp_path):
    for seed in (0, 1):
        assert run_model(drawn, *SHORT, "--seed", seed, "--output", tmp_path / f"{seed}.pt").returncode == 0
    assert same(weights(tmp_path / "0.pt"), weights(finished[1] / "model.pt"))
    assert not same(weights(tmp_path / "1.pt"), weights(finished[1] / "model.pt"))


def test_killed_anywhere_and_resumed_ends_with_the_same_weights(finished, drawn, tmp_path):
    output, chance = tmp_path / "model.pt", random.Random(5)
    kills = 0
    while True:
        run = subprocess.Popen(
            [*SAVING, str(drawn), *map(str, SHORT), "--output", str(output), "--resume"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        if kills == 4:
            break
        resume = tmp_path / "model-resume.pt"
        while run.poll() is None and not resume.exists():
            time.sleep(0.05)
        begun = resume.stat().st_mtime_ns
        while run.poll() is None and resume.stat().st_mtime_ns == begun:
            time.sleep(0.01)  # it has come further than the run before
        time.sleep(chance.uniform(0, 0.6))
        run.kill()
        run.wait()
        kills += 1
    assert run.wait() == 0, run.stderr.read()
    assert same(weights(output), weights(finished[1] / "model.pt"))
    assert same(weights(tmp_path / "model-best.pt"), weights(finished[1] / "model-best.pt"))
    ours, theirs = (
        [{name: row[name] for name in ("images", "loss", "val_loss")} for row in log(folder)]
        for folder in (tmp_path, finished[1])
    )
    assert ours == theirs


def test_killed_when_an_epoch_was_just_saved_loses_nothing_of_its_log(finished, drawn, tmp_path):
    killed = [
        sys.executable,
        "-c",
        f"import os, sys; sys.path.insert(0, {str(ROOT)!r}); import model; "
        "save = model.Run.save; "
        "model.Run.save = lambda run, *models: (save(run, *models), models and os._exit(9)); model.main()",
    ]
    arguments = (drawn, *SHORT, "--output", tmp_path / "model.pt", "--resume")
    assert [run_model(*arguments, command=killed).returncode for _ in range(2)] == [9, 9]
    done = run_model(*arguments)
    assert done.returncode == 0, done.stderr
    assert [row["val_loss"] for row in log(tmp_path)] == [row["val_loss"] for row in log(finished[1])]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_cleanly_with_everything_saved(finished, drawn, tmp_path, number):
    output = tmp_path / "model.pt"
    command = [sys.executable, str(ROOT / "model.py"), str(drawn), *map(str, SHORT), "--output", str(output)]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in run.stdout:
        if line.startswith("Epoch"):
            break
    run.send_signal(number)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 128 + number
    assert "--resume" in errors
    assert "Traceback" not in errors
    place = torch.load(tmp_path / "model-resume.pt", weights_only=True)["training"]
    assert 0 < place["images"] < 150  # in the middle of an epoch
    assert run_model(drawn, "--output", output, "--resume").returncode == 0
    assert same(weights(output), weights(finished[1] / "model.pt"))


def test_disk_full_is_clear_and_the_last_checkpoint_stays(finished, drawn, tmp_path):
    output = tmp_path / "model.pt"
    assert run_model(drawn, *SHORT, "--epochs", 1, "--output", output).returncode == 0
    before = {path: path.read_bytes() for path in tmp_path.glob("*.pt")}
    limit = 3_000_000  # the state is 6.7 MB

    full = run_model(
        "--output",
        output,
        "--resume",
        "--epochs",
        2,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert full.returncode == 1
    assert "model-resume.pt: File too large" in full.stderr
    assert "Traceback" not in full.stderr
    assert (tmp_path / "model-resume.pt").read_bytes() == before[tmp_path / "model-resume.pt"]
    assert not list(tmp_path.glob(".*.part"))
    assert run_model("--output", output, "--resume", "--epochs", 2).returncode == 0
    assert same(weights(output), weights(finished[1] / "model.pt"))


def test_resume_refuses_other_arguments_and_other_recordings(finished, drawn, tmp_path):
    output = tmp_path / "model.pt"
    assert run_model(drawn, *SHORT, "--epochs", 1, "--output", output).returncode == 0
    other = run_model("--output", output, "--resume", "--learning-rate", 0.1)
    assert other.returncode == 2
    assert "--learning-rate 0.0001, not 0.1" in other.stderr
    changed = run_model(draw_recording(tmp_path / "other", rows=20, seed=1), "--output", output, "--resume")
    assert changed.returncode == 2
    assert "recordings were others" in changed.stderr


def test_a_new_run_keeps_the_models_of_the_one_before(finished, drawn, tmp_path):
    for seed in (0, 1):
        done = run_model(drawn, *SHORT, "--epochs", 1, "--seed", seed, "--output", tmp_path / "model.pt")
        assert done.returncode == 0
    assert torch.load(tmp_path / "model-previous.pt", weights_only=True)["arguments"]["seed"] == 0


def test_no_recordings(tmp_path):
    for arguments in ([], ["nowhere"], ["."]):
        done = run_model(*arguments, cwd=tmp_path)
        assert done.returncode == 2
        assert "data/README.md" in done.stderr
        assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--epochs", "0"], "--epochs"),
        (["--learning-rate", "nan"], "--learning-rate"),
        (["--throttle-threshold", "2"], "--throttle-threshold drops"),
        (["--batch-size", "x"], "int"),
    ],
)
def test_arguments_that_cannot_be(drawn, tmp_path, arguments, words):
    done = run_model(drawn, *arguments, "--output", tmp_path / "model.pt")
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_a_damaged_image_is_named_and_left_out_and_strict_stops(copied, tmp_path):
    damaged = sorted((copied / "IMG").glob("left*"))[3]
    damaged.write_bytes(damaged.read_bytes()[:1000])
    lenient = run_model(copied, *SHORT, "--epochs", 1, "--output", tmp_path / "model.pt")
    assert lenient.returncode == 0, lenient.stderr
    assert f"line 4: left out: IMG/{damaged.name}: cut short" in lenient.stdout
    assert damaged.name in (tmp_path / "rejected_rows.csv").read_text()
    strict = run_model(copied, *SHORT, "--strict", "--output", tmp_path / "strict.pt")
    assert strict.returncode == 2
    assert damaged.name in strict.stderr
    assert not (tmp_path / "strict.pt").exists()


def test_default_is_every_recording_under_data(tmp_path):
    for i, name in enumerate(("lake", "turn-repetitive")):
        draw_recording(tmp_path / "data" / name, rows=20, seed=i)
    done = run_model(*SHORT, "--epochs", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    totals = [line.split()[-4:] for line in done.stdout.splitlines() if line.startswith("total")]
    assert totals == [["40", "0", "4", "36"]]
    assert (tmp_path / "model.pt").exists()


TORCHRUN = [
    sys.executable,
    "-m",
    "torch.distributed.run",
    "--nproc_per_node=2",
    "--master_port=0",
    "--standalone",
    str(ROOT / "model.py"),
]


def test_two_processes_go_on_with_the_runs_own_arguments(finished, drawn, tmp_path):
    begun = run_model(drawn, *SHORT, "--epochs", 1, "--output", tmp_path / "model.pt", command=TORCHRUN)
    resumed = run_model("--output", tmp_path / "model.pt", "--resume", "--epochs", 2, command=TORCHRUN)
    assert (begun.returncode, resumed.returncode) == (0, 0), begun.stderr + resumed.stderr
    a, b = weights(finished[1] / "model.pt"), weights(tmp_path / "model.pt")
    for name in a:
        assert (a[name] - b[name]).abs().mean() < 2e-6


def test_two_processes_train_as_one(drawn, tmp_path):
    """Two ranks with half of every batch each end where one process ends, up to rounding; rank 0 alone prints."""
    one = run_model(drawn, *SHORT, "--output", tmp_path / "one.pt")
    two = run_model(drawn, *SHORT, "--output", tmp_path / "two.pt", command=TORCHRUN)
    assert (one.returncode, two.returncode) == (0, 0), one.stderr + two.stderr
    a, b = weights(tmp_path / "one.pt"), weights(tmp_path / "two.pt")
    for name in a:  # Adam moves a weight by up to 1e-4 a step, of which there were 12
        assert (a[name] - b[name]).abs().mean() < 2e-6
    logs = [
        [
            float(number)
            for line in run.stdout.splitlines()
            if "val_loss" in line
            for number in re.findall(r"loss: ([\d.]+)", line)
        ]
        for run in (one, two)
    ]
    assert len(logs[0]) == 4 and logs[1] == pytest.approx(logs[0], abs=2e-4)  # the global losses; bfloat16 rounds


def test_a_given_value_counts_as_given_also_when_it_is_the_default():
    assert model.parse(["--resume", "--epochs", "10"])[1] == {"resume": True, "epochs": 10}
    assert model.parse([])[1] == {}


def test_importing_does_nothing(tmp_path):
    done = run_model(
        command=[sys.executable, "-c", "import model, cloning.recordings.log, cloning.pilot.network"],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT)},
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not os.listdir(tmp_path)
