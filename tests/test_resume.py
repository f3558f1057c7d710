"""Kills, signals, full disks and --resume: nothing is lost, and no run takes the models of an earlier one away."""

import json
import os
import shutil
import signal
import sys
from dataclasses import replace
from unittest.mock import Mock, patch

import numpy as np
import pytest
import torch
import warm
from commands import HERE, SHORT, TINY, edited, finished_run, log, python, refused, run_here, same, trained, weights
from killed import ALL
from rendered import render_recording

import model
from cloning.training.distributed import Ranks
from cloning.training.options import Process
from cloning.training.recipe import LIMITS
from cloning.training.stop import Interrupted, StopSignals, status_of
from model import REPORT


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


# A run that gets a signal when its first epoch begins; SIGHUP twice, as a closed terminal may send it.
SIGNALLED = """
import os, signal, sys, model
from cloning.base import program

number = int(sys.argv.pop(1))

def told(*words, **more):
    print(*words, **more)
    for _ in range(1 + (number == signal.SIGHUP)):
        if words[0].startswith("Epoch"):
            os.kill(os.getpid(), number)

model.print = told
program.name = "model.py"
program.run(model.main)
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_ends_cleanly_and_the_resumed_run_ends_as_one_that_was_not_interrupted(
    finished, sample_recording, tmp_path, name
):
    output, number = tmp_path / "model.pt", getattr(signal, name)
    run = python("-c", SIGNALLED, int(number), sample_recording, *SHORT, "--output", output)
    assert run.returncode == 128 + number
    assert run.stderr.startswith("model.py: ") and "--resume" in run.stderr
    assert "Traceback" not in run.stderr
    state = torch.load(tmp_path / "model-resume.pt", weights_only=True)["training"]
    assert 0 < state["images"] < 80  # in the middle of an epoch
    trained(sample_recording, "--output", output, "--resume")
    for name in ("model.pt", "model-best.pt"):
        assert same(weights(tmp_path / name), weights(finished[1] / name))
    ours, theirs = (
        [{name: row[name] for name in ("images", "loss", "val_loss")} for row in log(folder)]
        for folder in (tmp_path, finished[1])
    )
    assert ours == theirs
    assert not list(tmp_path.glob("*previous*"))  # a run never takes its own files for an earlier run's


def test_a_signal_does_not_wait_for_the_validation(finished, sample_recording, tmp_path, monkeypatch):
    def drifts(*_):
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it has waited")

    monkeypatch.setattr(model, "drifts", drifts)
    output = tmp_path / "model.pt"
    assert model.main([str(sample_recording), *map(str, SHORT), "--output", str(output)]) == 128 + signal.SIGINT
    assert torch.load(tmp_path / "model-resume.pt", weights_only=True)["training"]["images"] >= 80, "the whole epoch"
    monkeypatch.undo()
    trained(sample_recording, "--output", output, "--resume")
    assert same(weights(output), weights(finished[1] / "model.pt"))
    saved = list[str]()
    with pytest.raises(Interrupted), StopSignals() as stop:
        signal.raise_signal(signal.SIGINT)
        with stop.at_once(lambda: saved.append("other ranks wait for this one"), alone=False):
            assert not saved
        with pytest.raises(Interrupted), stop.at_once(lambda: saved.append("state"), alone=True):
            pytest.fail("it has waited")
        assert saved == ["state"]


# A run whose terminal is its standard input.
WITH_TERMINAL = """
import fcntl, termios, model
from cloning.base import program

fcntl.ioctl(0, termios.TIOCSCTTY, 0)
program.run(model.main)
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
def test_a_run_whose_terminal_is_closed_saves_its_state(sample_recording, tmp_path):
    ours, its = os.openpty()
    long = [*map(str, SHORT), "--epochs", "100"]  # so that it still runs when its terminal is closed
    command = [sys.executable, "-c", WITH_TERMINAL, str(sample_recording), *long, "--output", "model.pt"]
    files = {"stdin": its, "stdout": its, "stderr": its}
    run = warm.Popen(command, cwd=tmp_path, env={**os.environ, **HERE}, start_new_session=True, **files)
    os.close(its)
    printed = b""
    while b"Epoch" not in printed:
        printed += os.read(ours, 1000)
    os.close(ours)
    assert run.wait(60) == 128 + signal.SIGHUP
    assert torch.load(tmp_path / "model-resume.pt", weights_only=True)["training"]["images"] > 0


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
def test_a_training_outlives_its_terminal_after_nohup():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with StopSignals() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
    assert signal.signal(signal.SIGHUP, before) == signal.SIG_IGN and not stop.received


@pytest.mark.skipif(os.name == "nt", reason="Windows sends a process no signals")
def test_a_terminal_that_is_closed_while_the_state_is_saved_does_not_end_that(monkeypatch):
    monkeypatch.setattr(os, "isatty", lambda file: False)  # the test's own stays
    saved = list[str]()

    def save():
        signal.raise_signal(signal.SIGHUP)
        saved.append("state")

    with pytest.raises(Interrupted), StopSignals() as stop:
        signal.raise_signal(signal.SIGHUP)
        with stop.at_once(save, alone=True):
            pytest.fail("it has waited")
    assert saved == ["state"]


# ----------------------------------------------------------------------------------------------------------------------
# --resume, and the models of earlier runs


def test_resume_refuses_other_arguments_and_other_recordings(begun, copied, tmp_path):
    output, rejected = begun / "model.pt", begun / "rejected_rows.csv"
    rejected.write_text("the run's", encoding="utf-8")
    resume = ("--output", output, "--resume")
    assert "--learning-rate 0.0001, not 0.1" in refused(*resume, "--learning-rate", 0.1)
    assert "the run began with --from ''" in refused(*resume, "--from", output)
    other, few = render_recording(tmp_path / "other", rows=20, seed=1), render_recording(tmp_path / "few", rows=3)
    left = sorted((copied / "IMG").glob("left*"))
    shutil.copy(left[0], left[1])  # a side image alone
    for changed in (other, copied):
        assert "with other recordings, or by a version that reads them otherwise; re" in refused(changed, *resume)
    assert "record more" in refused(few, *resume)
    assert rejected.read_text(encoding="utf-8") == "the run's"
    with edited(begun / "model-resume.pt") as saved:
        saved["training"]["images"] = 4
    assert "the run is in epoch 2; give more --epochs" in refused(*resume, "--epochs", 1)
    with edited(begun / "model-resume.pt") as saved:
        saved["training"]["labels"][0] += 0.1
    assert "with other recordings, or by a version" in refused(*resume, "--epochs", 2)


def test_a_moved_run_continues_where_it_is(finished, sample_recording, tmp_path):
    """Where and how a run was started never comes out of its checkpoint: output, device, strict."""
    trained(sample_recording, *SHORT, "--epochs", 1, "--strict", "--output", "runs/a/model.pt", cwd=tmp_path)
    folder = tmp_path / "runs" / "a"
    with edited(folder / "model-resume.pt") as saved:
        assert not {"output", "device", "strict", "resume"} & saved["arguments"].keys()
        saved["training"]["labels"][0] += 0.01  # as on another processor
    printed = trained("--resume", "--epochs", 2, "--device", "cpu", cwd=folder)
    assert "labels differ by up to 0.01, as --robust's on another" in printed
    assert not (folder / "runs").exists()
    assert same(weights(folder / "model.pt"), weights(finished[1] / "model.pt"))
    arguments = json.loads((folder / "training_arguments.json").read_text(encoding="utf-8"))
    assert (arguments["output"], arguments["device"], arguments["strict"]) == ("model.pt", "cpu", False)
    assert arguments["recipe"]["batch_size"] == 8


EARLIER = ["epochs", "batch_size", "learning_rate", "samples_per_epoch"]  # the figures that were options
EARLIER += ["throttle_threshold", "side_correction", "repeats"]


def test_a_checkpoint_of_an_earlier_version_is_resumed(finished, begun, sample_recording):
    """Its arguments were flat, with those of the process and one that is gone; no identifier, no drift of an epoch.

    The side images were not in its fingerprint.
    """
    _, training, validation, _ = model.prepare(model.options.parse([str(sample_recording)], REPORT, model.ROBUST))
    fingerprint = model.Data.of(training, validation).fingerprints[-1]
    for name in ("model", "model-best", "model-resume"):
        with edited(begun / f"{name}.pt") as saved:
            del saved["run"], saved["layers"], saved["history"][0]["val_drift"]
            if "training" in saved:
                saved["training"]["fingerprint"] = fingerprint
            flat = {figure: saved["arguments"]["recipe"][figure] for figure in EARLIER}
            process = {"output": "elsewhere.pt", "device": "cuda", "strict": True, "resume": False}
            more = {"recordings": saved["arguments"]["recordings"], "seed": 0, "from_": "", "robust": False, "gone": 1}
            saved["arguments"] = flat | process | more | {"optimizer": "adam", "loss": "squared"}
    trained("--output", begun / "model.pt", "--resume", "--epochs", 2, "--device", "cpu")
    assert same(weights(begun / "model.pt"), weights(finished[1] / "model.pt"))
    assert not list(begun.glob("*previous*"))
    assert [row["val_drift"] for row in log(begun)] == ["", ""], "a recording of four seconds has no stretch to drive"


def test_a_run_is_resumed_only_by_its_own_recipe(begun, sample_recording, capsys):
    short = replace(REPORT, epochs=1, samples_per_epoch=80, batch_size=8)
    for changed, words in (
        (replace(short, flip=0.5), "--flip 0.9, not 0.5"),
        (replace(short, order=lambda *_: np.arange(3)), "order is 'shuffle'"),
    ):
        assert model.train(changed, [sample_recording], begun / "model.pt", device="cpu", resume=True) == 2
        assert words in capsys.readouterr().err
    assert model.train(short, ["nowhere"], begun / "model.pt", device="cpu", resume=True) == 2, "nor by its own data"
    more = replace(short, epochs=2)
    assert model.train(more, [sample_recording], begun / "model.pt", device="cpu", resume=True) == 0


def test_a_finished_run_that_is_resumed_says_how_to_train_on_and_has_its_own_models_and_losses_again(begun):
    """Its models may have been moved away, and a run in the same folder may have replaced its losses."""
    before, losses = weights(begun / "model.pt"), (begun / "training_log.csv").read_bytes()
    (begun / "training_log.csv").write_bytes(losses.replace(b"\n1,", b"\n9,"))
    for name in ("model.pt", "model-best.pt", "training_loss.png"):
        (begun / name).unlink()
    told = trained("--output", begun / "model.pt", "--resume")
    assert "the run has finished its 1 epoch; for more, raise --epochs" in told and "resumed in epoch" not in told
    assert same(weights(begun / "model.pt"), before)
    assert (begun / "training_log.csv").read_bytes() == losses and (begun / "training_loss.png").exists()


def test_a_recording_and_one_below_it_are_found_again(sample_recording, tmp_path):
    data, below = shutil.copytree(sample_recording, tmp_path / "data"), tmp_path / "data" / "lake"
    for folder, seed in ((below, 1), (data / "later", 2)):
        render_recording(folder, rows=20, seed=seed)
        command = (data, *TINY, "--epochs", seed, "--output", tmp_path / "model.pt", "--resume")
        if folder == below:
            assert "data/lake" in trained(*command), "both"
            trained("--output", tmp_path / "model.pt", "--resume", "--epochs", 1)
            trained(*command)
        else:
            assert "the run began with other recordings" in refused(*command)
            trained("--output", tmp_path / "model.pt", "--resume")  # with those of the run
    os.rename(data, tmp_path / "moved")
    assert "data: no such folder. Put the recording back, or name its new" in refused(*command[-3:])


def test_a_new_run_keeps_the_models_of_the_ones_before(begun, sample_recording):
    """All files of a run get the same ending, also if one of them was missing."""
    (begun / "model-best.pt").unlink()
    for seed in (1, 2):
        told = trained(sample_recording, *TINY, "--seed", seed, "--output", begun / "model.pt")
        assert f"{begun / 'model.pt'} of an earlier run is now" in told
    endings = ("-previous", "-previous-2", "")
    expected = {f"{name}{ending}.pt": seed for name in MODELS for seed, ending in enumerate(endings)}
    del expected["model-best-previous.pt"]
    assert seeds(begun) == expected


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def seeds(folder):
    """The seed in each model file of a folder: of the run that wrote it."""
    return {path.name: seed_of(path) for path in folder.glob("*.pt")}


MODELS = ("model", "model-best", "model-resume")


@pytest.mark.parametrize("kill_at", range(1, 13) if ALL else (1, 2, 3, 8, 9, 10, 11, 12))
def test_killed_at_any_change_of_a_file(begun, sample_recording, tmp_path, monkeypatch, kill_at):
    """At each point --resume continues the run that model-resume.pt is of, and each earlier run's model is kept once.

    Changes: 1 copy of model-resume.pt, 2 model-resume.pt, 3 progress, 4 arguments, 5 log, 6 picture, 7 and 8 copies of
    the models, 9 model.pt, 10 model-best.pt, 11 model-resume.pt, 12 progress. Diagnostic pictures and the cache are not
    counted.
    """
    changes, replace = 0, os.replace

    def dying(source, target):
        nonlocal changes
        is_counted = target.parent == begun
        changes += is_counted
        if is_counted and changes == kill_at:
            raise Killed
        replace(source, target)

    command = (sample_recording, *TINY, "--output", begun / "model.pt")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", dying)
        patch.setattr(os, "rename", dying)
        with pytest.raises(Killed):
            run_here(*command, "--seed", 1)
    for name, point in zip(MODELS[:2], (9, 10), strict=True):  # the earlier run's until the new one has an epoch
        assert seed_of(begun / f"{name}.pt") == (kill_at > point)
    new_run_begun = kill_at > 2
    assert seed_of(begun / "model-resume.pt") == new_run_begun
    copy = shutil.copytree(begun, tmp_path / "copy")
    trained("--output", copy / "model.pt", "--resume", "--epochs", 1)
    previous = {f"{name}-previous.pt": 0 for name in MODELS}
    copied = {"model-resume-previous.pt": 0} if kill_at == 2 else {}  # for the new run, which has not begun
    assert seeds(copy) == {f"{name}.pt": new_run_begun for name in MODELS} | (previous if new_run_begun else copied)
    trained(*command, "--seed", 2)
    kept = {f"{name}-previous-2.pt": 1 for name, point in zip(MODELS, (9, 10, 11), strict=True) if kill_at > point}
    assert seeds(begun) == {f"{name}.pt": 2 for name in MODELS} | previous | kept


@pytest.mark.parametrize("samples, save_seconds", [(80, 1e9), (80, 0), (1, 1e9)], ids=["batch", "save", "validation"])
def test_a_run_that_diverges_stops_and_saves_nothing_of_it(
    begun, sample_recording, monkeypatch, capsys, samples, save_seconds
):
    """The first step's loss is finite, but the weights after it are not."""
    monkeypatch.setitem(LIMITS, "learning_rate", (0, np.inf))
    before = (begun / "training_log.csv").read_bytes()
    recipe = replace(REPORT, epochs=2, samples_per_epoch=samples, batch_size=8, learning_rate=np.inf)
    process = {"device": "cpu", "save_seconds": save_seconds}
    assert model.train(recipe, [sample_recording], begun / "model.pt", seed=1, **process) == 2
    message = "python: epoch 1: the loss is not finite; start again with a smaller --learning-rate than inf\n"
    assert capsys.readouterr().err == message
    assert seeds(begun) == {"model.pt": 0, "model-best.pt": 0, "model-resume.pt": 1, "model-resume-previous.pt": 0}
    assert torch.load(begun / "model-resume.pt", weights_only=True)["training"]["images"] == 0
    assert (begun / "training_log.csv").read_bytes() == before


def test_resume_does_not_replace_the_models_of_another_run(begun, sample_recording):
    command = (sample_recording, *TINY, "--output", begun / "model.pt")
    trained(*command, "--seed", 1)
    shutil.copy(begun / "model-resume-previous.pt", begun / "model-resume.pt")
    resume = ("--output", begun / "model.pt", "--resume", "--epochs", 2)
    assert f"{begun / 'model.pt'}: damaged, or of another run than model-resume.pt" in refused(*resume)
    for name in ("model", "model-best"):
        os.replace(begun / f"{name}-previous.pt", begun / f"{name}.pt")
    trained(*resume)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no locks on folders")
def test_two_runs_never_write_to_the_same_folder(begun, sample_recording, monkeypatch):
    before = files(begun)
    others = []

    def meanwhile(*arguments):
        others.append(python("model.py", sample_recording, *SHORT, "--output", begun / "model.pt", *arguments))
        others.append(python("model.py", sample_recording, *SHORT, "--output", begun / "other.pt"))
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(model, "read_observations", meanwhile)
        with pytest.raises(Killed):
            run_here(sample_recording, *SHORT, "--output", begun / "model.pt")
    assert [run.returncode for run in others] == [2, 2]
    assert all("another program writes there" in run.stderr for run in others)
    assert files(begun) == before


def test_a_run_whose_folder_was_moved_and_made_anew_leaves_the_next_one_its_models(sample_recording, tmp_path):
    command, validate = (sample_recording, *TINY, "--output", tmp_path / "run" / "model.pt"), model.TrainingRun.validate

    def meanwhile(run):
        os.rename(tmp_path / "run", tmp_path / "moved")
        assert python("model.py", *command, "--seed", 1).returncode == 0
        return validate(run)

    with patch.object(model.TrainingRun, "validate", meanwhile):
        told = refused(*command, "--seed", 2)
    assert "model-resume.pt: now of another run, which goes on; start this one in another folder" in told
    assert seeds(tmp_path / "run") == dict.fromkeys((f"{name}.pt" for name in MODELS), 1)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device", "disk")])
@pytest.mark.parametrize("function, advice", [("Checkpoint", "start the run again"), ("write_losses", "--resume")])
def test_resume_is_recommended_only_once_the_new_run_has_a_state(
    begun, sample_recording, monkeypatch, error, function, advice
):
    """Before, --resume would continue the earlier run."""
    monkeypatch.setattr(model, function, Mock(side_effect=error))
    done = run_here(sample_recording, *TINY, "--seed", 1, "--output", begun / "model.pt")
    assert done.returncode in (2, 130)
    assert ("--resume" in done.stderr) == (advice == "--resume") and advice in done.stderr
    assert seed_of(begun / "model-resume.pt") == (advice == "--resume")


def test_a_gpu_that_fails_is_told_with_the_remedy(tmp_path, capsys):
    """As an older one does for which PyTorch has no kernels, or one whose machine has slept."""
    process, more = Process(str(tmp_path / "model.pt")), "\nFor debugging consider …"
    for kind, error in (
        (torch.AcceleratorError, "CUDA error: no kernel image is available for execution on the device"),
        (torch.OutOfMemoryError, "CUDA out of memory."),
        (NotImplementedError, "The operator 'aten::median' is not currently implemented for the MPS device."),
    ):
        assert status_of(Mock(side_effect=kind(error + more)), process, Ranks()) == 2
        told = capsys.readouterr().err
        assert told == f"python: {error}; leave the GPU out with --device cpu, and start the run again\n"
    with pytest.raises(RuntimeError, match="a fault"):
        status_of(Mock(side_effect=RuntimeError("a fault")), process, Ranks())
