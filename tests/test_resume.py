"""Kills, signals, full disks and --resume: nothing is lost, and no run takes the models of an earlier one away."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from conftest import HERE, ROOT, SHORT, finished_run, log, render_recording, run_here, run_model, same, weights

import model
from cloning.training import checkpoint

# The same command, but it saves after every batch: kills then strike at every place of an epoch, and while writing.
SAVING = [sys.executable, "-c", "import sys, model; model.SAVE_SECONDS = 0; sys.exit(model.main())"]


class Killed(BaseException):
    """As if the process were killed here: nothing in the program catches it."""


def seed_of(path):
    return torch.load(path, weights_only=True)["arguments"]["seed"]


@pytest.fixture(scope="module")
def one_epoch(sample_recording, tmp_path_factory):
    """The folder of a run of one epoch, with seed 0; not to be changed."""
    return finished_run(sample_recording, tmp_path_factory.mktemp("one epoch"), *SHORT, "--epochs", 1)[1]


@pytest.fixture
def begun(one_epoch, tmp_path):
    """The folder of a run of one epoch, with seed 0, that a test may change."""
    return shutil.copytree(one_epoch, tmp_path / "begun")


def test_killed_anywhere_and_resumed_ends_with_the_same_weights(finished, sample_recording, tmp_path):
    output, chance = tmp_path / "model.pt", random.Random(5)
    kills = 0
    while True:
        run = subprocess.Popen(
            [*SAVING, str(sample_recording), *map(str, SHORT), "--output", str(output), "--resume"],
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


def test_killed_when_an_epoch_was_just_saved_loses_nothing_of_its_log(finished, sample_recording, tmp_path):
    killed = [
        sys.executable,
        "-c",
        "import os, model; save = model.TrainingRun.save; "
        "model.TrainingRun.save = lambda run, *models: (save(run, *models), models and os._exit(9)); model.main()",
    ]
    arguments = (sample_recording, *SHORT, "--output", tmp_path / "model.pt", "--resume")
    assert [run_model(*arguments, command=killed, env=HERE).returncode for _ in range(2)] == [9, 9]
    done = run_here(*arguments)
    assert done.returncode == 0, done.stderr
    assert [row["val_loss"] for row in log(tmp_path)] == [row["val_loss"] for row in log(finished[1])]


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_cleanly_with_everything_saved(finished, sample_recording, tmp_path, number):
    output = tmp_path / "model.pt"
    command = [sys.executable, str(ROOT / "model.py"), str(sample_recording), *map(str, SHORT), "--output", str(output)]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for line in run.stdout:
        if line.startswith("Epoch"):
            break
    run.send_signal(number)
    _, errors = run.communicate(timeout=120)
    assert run.returncode == 128 + number
    assert errors.startswith("model.py: ") and "--resume" in errors
    assert "Traceback" not in errors
    place = torch.load(tmp_path / "model-resume.pt", weights_only=True)["training"]
    assert 0 < place["images"] < 150  # in the middle of an epoch
    assert run_here(sample_recording, "--output", output, "--resume").returncode == 0
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
    assert full.returncode == 2
    assert "model-resume.pt: File too large" in full.stderr
    assert "Traceback" not in full.stderr
    assert (begun / "model-resume.pt").read_bytes() == before
    assert not list(begun.glob(".*.part"))
    assert run_here("--output", output, "--resume", "--epochs", 2).returncode == 0
    assert same(weights(output), weights(finished[1] / "model.pt"))


# ----------------------------------------------------------------------------------------------------------------------
# --resume, and the models of earlier runs


def test_resume_refuses_other_arguments_and_other_recordings(begun, tmp_path):
    output = begun / "model.pt"
    other = run_here("--output", output, "--resume", "--learning-rate", 0.1)
    assert other.returncode == 2
    assert "--learning-rate 0.0001, not 0.1" in other.stderr
    changed = run_here(render_recording(tmp_path / "other", rows=20, seed=1), "--output", output, "--resume")
    assert changed.returncode == 2
    assert "the run began with other recordings" in changed.stderr


def test_resume_refuses_a_state_that_does_not_fit(begun):
    saved = torch.load(begun / "model-resume.pt", weights_only=True)
    del saved["training"]["optimizer"]
    torch.save(saved, begun / "model-resume.pt")
    done = run_here("--output", begun / "model.pt", "--resume", "--epochs", 2)
    assert done.returncode == 2
    assert str(begun / "model-resume.pt") in done.stderr


def test_a_moved_run_continues_where_it_is(finished, sample_recording, tmp_path):
    """Where and how a run was started never comes out of its checkpoint: output, device, strict."""
    begun = run_here(sample_recording, *SHORT, "--epochs", 1, "--strict", "--output", "runs/a/model.pt", cwd=tmp_path)
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


def test_a_new_run_keeps_the_models_of_the_ones_before(begun, sample_recording):
    for seed in (1, 2):
        done = run_here(sample_recording, *SHORT, "--epochs", 1, "--seed", seed, "--output", begun / "model.pt")
        assert done.returncode == 0, done.stderr
        assert f"{begun / 'model.pt'} of an earlier run is now" in done.stdout
    for kind in ("model", "model-best", "model-resume"):
        names = [begun / f"{kind}{ending}.pt" for ending in ("-previous", "-previous-2", "")]
        assert [seed_of(name) for name in names] == [0, 1, 2]


@pytest.mark.parametrize("before_the_end", ["in the first epoch", "while it is saved"])
def test_a_new_run_leaves_the_model_in_place_until_its_first_epoch_has_ended(
    begun, sample_recording, monkeypatch, before_the_end
):
    old = (begun / "model.pt").read_bytes(), (begun / "model-best.pt").read_bytes()

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        if before_the_end == "in the first epoch":
            patch.setattr(model.TrainingRun, "validate", interrupted)
        else:
            patch.setattr(model, "loss_picture", interrupted)
        stopped = run_here(sample_recording, *SHORT, "--seed", 1, "--output", begun / "model.pt")
    assert stopped.returncode == 128 + signal.SIGINT
    assert ((begun / "model.pt").read_bytes(), (begun / "model-best.pt").read_bytes()) == old
    assert seed_of(begun / "model-resume-previous.pt") == 0
    assert seed_of(begun / "model-resume.pt") == 1
    again = run_here(sample_recording, *SHORT, "--seed", 2, "--epochs", 1, "--output", begun / "model.pt")
    assert again.returncode == 0, again.stderr
    assert ((begun / "model-previous.pt").read_bytes(), (begun / "model-best-previous.pt").read_bytes()) == old
    assert not (begun / "model-resume-previous-2.pt").exists()  # the stopped run had no finished epoch


@pytest.mark.parametrize("kill_after", range(1, 5))
def test_killed_while_earlier_models_are_renamed(begun, sample_recording, tmp_path, monkeypatch, kill_after):
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
    arguments = (sample_recording, *SHORT, "--epochs", 1, "--seed", 1, "--output", begun / "model.pt")
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
