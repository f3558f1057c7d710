"""The command line on a rendered recording: what a run leaves, that it learns, and that nothing is ever lost."""

import csv
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from conftest import ROOT, SHORT, draw_recording, finished_run, run_here, run_model, weights
from PIL import Image

import model
from cloning.training import checkpoint

HERE = {"PYTHONPATH": str(ROOT)}
# The same command, but it saves after every batch: kills then strike at every place of an epoch, and while writing.
SAVING = [sys.executable, "-c", "import sys, model; model.SAVE_SECONDS = 0; sys.exit(model.main())"]


class Killed(BaseException):
    """As if the process were killed here: nothing in the program catches it."""


def log(folder):
    with open(folder / "training_log.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def same(a, b):
    return all(torch.equal(a[name], b[name]) for name in a)


def seed_of(path):
    return torch.load(path, weights_only=True)["arguments"]["seed"]


@pytest.fixture(scope="module")
def finished(drawn, tmp_path_factory):
    return finished_run(drawn, tmp_path_factory.mktemp("run"), *SHORT)


@pytest.fixture(scope="module")
def one_epoch(drawn, tmp_path_factory):
    """The folder of a run of one epoch, with seed 0; not to be changed."""
    return finished_run(drawn, tmp_path_factory.mktemp("one epoch"), *SHORT, "--epochs", 1)[1]


@pytest.fixture
def begun(one_epoch, tmp_path):
    """The folder of a run of one epoch, with seed 0, that a test may change."""
    return shutil.copytree(one_epoch, tmp_path / "begun")


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
    assert lines[-1] == f"next: python drive.py {finished[1] / 'model.pt'}"


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
    assert json.loads((folder / "training_arguments.json").read_text(encoding="utf-8"))["batch_size"] == 8
    saved = torch.load(folder / "model.pt", weights_only=True)
    assert [row["epoch"] for row in saved["history"]] == [1, 2]
    best = min(rows, key=lambda row: float(row["val_loss"]))
    assert same(weights(folder / "model-best.pt"), weights(folder / "model.pt")) == (best["epoch"] == "2")
    for name in ("training_generator_LRC_0.png", "training_generator_augmented-0.png"):
        assert Image.open(folder / "diagnostic_images" / name).size[0] > 1000


def test_training_learns(drawn, tmp_path):
    """After a few seconds the network predicts frames that it was not trained on far better than the mean steering."""
    faster = ("--learning-rate", 1e-3, "--samples-per-epoch", 700, "--epochs", 3)
    done = run_here(drawn, *SHORT, *faster, "--output", tmp_path / "model.pt")
    table = [line.split() for line in done.stdout.splitlines()]
    errors = next(row[-4:] for row in table if row[:5] == ["steering", "of", "0", "to", "1"])
    steer_mean, last = float(errors[1]), float(errors[2])
    assert last < 0.3 * steer_mean
    correlations = next(row[-4:] for row in table if row[:1] == ["correlation"])
    assert float(correlations[2]) > 0.9
    assert "hardly follows" not in done.stdout


def test_same_seed_same_weights_other_seed_others(finished, drawn, tmp_path):
    for seed in (0, 1):
        assert run_here(drawn, *SHORT, "--seed", seed, "--output", tmp_path / f"{seed}.pt").returncode == 0
    assert same(weights(tmp_path / "0.pt"), weights(finished[1] / "model.pt"))
    assert not same(weights(tmp_path / "1.pt"), weights(finished[1] / "model.pt"))


def test_no_run_changes_a_tracked_file(drawn, tmp_path):
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "core.autocrlf=false"]
    if not shutil.which("git"):
        pytest.skip("git is not installed")
    for name in (".gitignore", "model.py", "data/README.md"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    for name in ("diagnostic_images/report", "cloning"):
        shutil.copytree(ROOT / name, tmp_path / name)
    for command in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "all"]):
        subprocess.run([*git, *command], cwd=tmp_path, check=True)
    shutil.copytree(drawn, tmp_path / "data" / "lake")
    damaged = next((tmp_path / "data" / "lake" / "IMG").glob("left*"))
    damaged.write_bytes(b"")  # so that rejected_rows.csv is written, too
    for _ in range(2):
        assert run_here(*SHORT, "--epochs", 1, cwd=tmp_path).returncode == 0
    assert (tmp_path / "model-previous.pt").exists() and (tmp_path / "rejected_rows.csv").exists()
    status = subprocess.run([*git, "status", "--porcelain"], cwd=tmp_path, check=True, capture_output=True, text=True)
    assert status.stdout == ""


# ----------------------------------------------------------------------------------------------------------------------
# Kills, signals and full disks


def test_killed_anywhere_and_resumed_ends_with_the_same_weights(finished, drawn, tmp_path):
    output, chance = tmp_path / "model.pt", random.Random(5)
    kills = 0
    while True:
        run = subprocess.Popen(
            [*SAVING, str(drawn), *map(str, SHORT), "--output", str(output), "--resume"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            env={**os.environ, **HERE},
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
    assert not list(tmp_path.glob("*previous*"))  # a run never takes its own files for an earlier run's


def test_killed_when_an_epoch_was_just_saved_loses_nothing_of_its_log(finished, drawn, tmp_path, monkeypatch):
    arguments = (drawn, *SHORT, "--output", tmp_path / "model.pt", "--resume")
    with monkeypatch.context() as patch:
        save = model.TrainingRun.save

        def save_and_die(run, *models):
            save(run, *models)
            if models:
                raise Killed

        patch.setattr(model.TrainingRun, "save", save_and_die)
        for _ in range(2):
            with pytest.raises(Killed):
                run_here(*arguments)
    done = run_here(*arguments)
    assert done.returncode == 0, done.stderr
    assert [row["val_loss"] for row in log(tmp_path)] == [row["val_loss"] for row in log(finished[1])]


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
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
    assert errors.startswith("model.py: ") and "--resume" in errors
    assert "Traceback" not in errors
    place = torch.load(tmp_path / "model-resume.pt", weights_only=True)["training"]
    assert 0 < place["images"] < 150  # in the middle of an epoch
    assert run_here(drawn, "--output", output, "--resume").returncode == 0
    assert same(weights(output), weights(finished[1] / "model.pt"))


def test_disk_full_is_clear_and_the_last_checkpoint_stays(finished, begun):
    resource = pytest.importorskip("resource", reason="only Unix can limit the size of files")
    output, before = begun / "model.pt", (begun / "model-resume.pt").read_bytes()
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
    assert (begun / "model-resume.pt").read_bytes() == before
    assert not list(begun.glob(".*.part"))
    assert run_here("--output", output, "--resume", "--epochs", 2).returncode == 0
    assert same(weights(output), weights(finished[1] / "model.pt"))


def test_it_trains_without_what_only_some_systems_have(drawn, tmp_path):
    """No SIGTERM, processor affinity, fork or mallopt, as on Windows or macOS."""
    code = (
        "import ctypes, os, signal, sys, torch\n"
        "del signal.SIGTERM, os.sched_getaffinity, os.fork\n"
        "ctypes.CDLL = lambda name: object()\n"
        "import model\n"
        "sys.exit(model.main())"
    )
    arguments = (drawn, *SHORT, "--epochs", 1, "--output", tmp_path / "model.pt")
    done = run_model(*arguments, command=[sys.executable, "-c", code], env=HERE)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "model.pt").exists()


# ----------------------------------------------------------------------------------------------------------------------
# --resume, and the models of earlier runs


def test_resume_refuses_other_arguments_and_other_recordings(begun, tmp_path):
    output = begun / "model.pt"
    other = run_here("--output", output, "--resume", "--learning-rate", 0.1)
    assert other.returncode == 2
    assert "--learning-rate 0.0001, not 0.1" in other.stderr
    changed = run_here(draw_recording(tmp_path / "other", rows=20, seed=1), "--output", output, "--resume")
    assert changed.returncode == 2
    assert "recordings were others" in changed.stderr


def test_resume_refuses_a_state_that_does_not_fit(begun):
    saved = torch.load(begun / "model-resume.pt", weights_only=True)
    del saved["training"]["optimizer"]
    torch.save(saved, begun / "model-resume.pt")
    done = run_here("--output", begun / "model.pt", "--resume", "--epochs", 2)
    assert done.returncode == 2
    assert str(begun / "model-resume.pt") in done.stderr


def test_a_moved_run_goes_on_where_it_is(finished, drawn, tmp_path):
    """Where and how a run was started never comes out of its checkpoint: output, device, strict."""
    begun = run_here(drawn, *SHORT, "--epochs", 1, "--strict", "--output", "runs/a/model.pt", cwd=tmp_path)
    assert begun.returncode == 0, begun.stderr
    folder = tmp_path / "runs" / "a"
    saved = torch.load(folder / "model-resume.pt", weights_only=True)
    saved["arguments"]["device"] = "cuda"  # as if begun on another machine
    torch.save(saved, folder / "model-resume.pt")
    resumed = run_here("--resume", "--epochs", 2, "--device", "cpu", cwd=folder)
    assert resumed.returncode == 0, resumed.stderr
    assert not (folder / "runs").exists()
    assert same(weights(folder / "model.pt"), weights(finished[1] / "model.pt"))
    arguments = json.loads((folder / "training_arguments.json").read_text(encoding="utf-8"))
    assert (arguments["output"], arguments["device"], arguments["strict"]) == ("model.pt", "cpu", False)
    assert arguments["batch_size"] == 8


def test_a_checkpoint_of_an_earlier_version_is_resumed(finished, begun):
    """It has no identifier of its run, and may have an option that is gone."""
    saved = torch.load(begun / "model-resume.pt", weights_only=True)
    del saved["run"]
    saved["arguments"]["gone"] = 1
    torch.save(saved, begun / "model-resume.pt")
    assert run_here("--output", begun / "model.pt", "--resume", "--epochs", 2).returncode == 0
    assert same(weights(begun / "model.pt"), weights(finished[1] / "model.pt"))
    assert not list(begun.glob("*previous*"))


def test_a_new_run_keeps_the_models_of_the_ones_before(begun, drawn):
    for seed in (1, 2):
        done = run_here(drawn, *SHORT, "--epochs", 1, "--seed", seed, "--output", begun / "model.pt")
        assert done.returncode == 0, done.stderr
        assert f"{begun / 'model.pt'} of an earlier run is now" in done.stdout
    for kind in ("model", "model-best", "model-resume"):
        names = [begun / f"{kind}{ending}.pt" for ending in ("-previous", "-previous-2", "")]
        assert [seed_of(name) for name in names] == [0, 1, 2]


@pytest.mark.parametrize("before_the_end", ["in the first epoch", "while it is saved"])
def test_a_new_run_leaves_the_model_in_place_until_its_first_epoch_has_ended(begun, drawn, monkeypatch, before_the_end):
    old = (begun / "model.pt").read_bytes(), (begun / "model-best.pt").read_bytes()

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if before_the_end == "in the first epoch":
            patch.setattr(model.TrainingRun, "validate", interrupted)
        else:
            patch.setattr(model, "loss_picture", interrupted)
        stopped = run_here(drawn, *SHORT, "--seed", 1, "--output", begun / "model.pt")
    assert stopped.returncode == 128 + signal.SIGINT
    assert ((begun / "model.pt").read_bytes(), (begun / "model-best.pt").read_bytes()) == old
    assert seed_of(begun / "model-resume-previous.pt") == 0
    assert seed_of(begun / "model-resume.pt") == 1
    again = run_here(drawn, *SHORT, "--seed", 2, "--epochs", 1, "--output", begun / "model.pt")
    assert again.returncode == 0, again.stderr
    assert ((begun / "model-previous.pt").read_bytes(), (begun / "model-best-previous.pt").read_bytes()) == old
    assert not (begun / "model-resume-previous-2.pt").exists()  # the stopped run had no finished epoch


@pytest.mark.parametrize("kill_after", range(1, 5))
def test_killed_while_the_earlier_models_make_room(begun, drawn, tmp_path, monkeypatch, kill_after):
    """After each of two renamed and two written models: --resume goes on, and every model is kept once."""
    steps = 0

    def then_die(function):
        def step(*arguments, **more):
            nonlocal steps
            function(*arguments, **more)
            steps += 1
            if steps == kill_after:
                raise Killed

        return step

    rename, save = checkpoint.set_aside, checkpoint.save_model
    arguments = (drawn, *SHORT, "--epochs", 1, "--seed", 1, "--output", begun / "model.pt")
    with monkeypatch.context() as patch:
        patch.setattr(
            checkpoint, "set_aside", lambda path: (rename if "resume" in path.stem else then_die(rename))(path)
        )
        patch.setattr(
            checkpoint,
            "save_model",
            lambda path, *more, **state: (save if "resume" in path.stem else then_die(save))(path, *more, **state),
        )
        with pytest.raises(Killed):
            run_here(*arguments)
    resumed = run_here("--output", begun / "model.pt", "--resume")
    assert resumed.returncode == 0, resumed.stderr
    found = {path.name: seed_of(path) for path in begun.glob("*.pt")}
    kinds = ("model", "model-best", "model-resume")
    assert found == {f"{kind}.pt": 1 for kind in kinds} | {f"{kind}-previous.pt": 0 for kind in kinds}


# ----------------------------------------------------------------------------------------------------------------------
# Arguments and recordings that cannot be


def test_no_recordings(tmp_path):
    for arguments in ([], ["nowhere"], ["."]):
        done = run_here(*arguments, cwd=tmp_path)
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
    done = run_here(drawn, *arguments, "--output", tmp_path / "model.pt")
    assert done.returncode == 2
    assert words in done.stderr
    assert "model.py: " in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("device", ["cuda", "mps"])
def test_a_device_that_is_not_there(drawn, tmp_path, monkeypatch, device):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    done = run_here(drawn, "--device", device, "--output", tmp_path / "model.pt")
    assert done.returncode == 2
    assert f"model.py: error: --device {device}: " in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_damaged_image_is_named_and_left_out_and_strict_stops(copied, tmp_path):
    damaged = sorted((copied / "IMG").glob("left*"))[3]
    damaged.write_bytes(damaged.read_bytes()[:1000])
    lenient = run_here(copied, *SHORT, "--epochs", 1, "--output", tmp_path / "model.pt")
    assert lenient.returncode == 0, lenient.stderr
    assert f"line 4: left out: IMG/{damaged.name}: cut short" in lenient.stdout
    assert damaged.name in (tmp_path / "rejected_rows.csv").read_text(encoding="utf-8")
    strict = run_here(copied, *SHORT, "--strict", "--output", tmp_path / "strict.pt")
    assert strict.returncode == 2
    assert damaged.name in strict.stderr
    assert not (tmp_path / "strict.pt").exists()


def test_default_is_every_recording_under_data(tmp_path):
    for i, name in enumerate(("lake", "turn-repetitive")):
        draw_recording(tmp_path / "data" / name, rows=20, seed=i)
    done = run_here(*SHORT, "--epochs", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    totals = [line.split()[-4:] for line in done.stdout.splitlines() if line.startswith("total")]
    assert totals == [["40", "0", "4", "36"]]
    assert (tmp_path / "model.pt").exists()


def test_a_given_value_counts_as_given_also_when_it_is_the_default():
    assert model.parse(["--resume", "--epochs", "10"]) == (
        model.Arguments(resume=True, epochs=10),
        {"resume", "epochs"},
    )
    assert model.parse([]) == (model.Arguments(), set())
    assert model.parse(["data"]) == (model.Arguments(), {"recordings"})


def test_importing_does_nothing(tmp_path):
    done = run_model(
        command=[sys.executable, "-c", "import model, cloning.recordings.log, cloning.pilot.network"],
        cwd=tmp_path,
        env=HERE,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not os.listdir(tmp_path)


# ----------------------------------------------------------------------------------------------------------------------
# Several processes

TORCHRUN = [
    sys.executable,
    "-m",
    "torch.distributed.run",
    "--nproc_per_node=2",
    "--master_port=0",
    "--standalone",
    str(ROOT / "model.py"),
]


@pytest.fixture(scope="module")
def two_processes(drawn, tmp_path_factory):
    """An epoch by two processes, and a second one that they resume with the run's own arguments: output, folder."""
    folder = tmp_path_factory.mktemp("two processes")
    begun = run_model(drawn, *SHORT, "--epochs", 1, "--output", folder / "model.pt", command=TORCHRUN)
    resumed = run_model("--output", folder / "model.pt", "--resume", "--epochs", 2, command=TORCHRUN)
    assert (begun.returncode, resumed.returncode) == (0, 0), begun.stderr + resumed.stderr
    return begun.stdout + resumed.stdout, folder


def test_two_processes_train_as_one_also_when_they_resume(finished, two_processes):
    """Two ranks with half of every batch each end where one process ends, up to rounding."""
    a, b = weights(finished[1] / "model.pt"), weights(two_processes[1] / "model.pt")
    for name in a:  # Adam moves a weight by up to 1e-4 a step, of which there were 12
        assert (a[name] - b[name]).abs().mean() < 2e-6


def test_two_processes_print_once_and_the_losses_of_both(finished, two_processes):
    logs = [
        [
            float(number)
            for line in output.splitlines()
            if "val_loss" in line
            for number in re.findall(r"loss: ([\d.]+)", line)
        ]
        for output in (finished[0].stdout, two_processes[0])
    ]
    assert len(logs[0]) == 4 and logs[1] == pytest.approx(logs[0], abs=2e-4)  # the global losses; bfloat16 rounds
