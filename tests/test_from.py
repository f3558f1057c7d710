"""model.py --from: a run that begins with the weights of a trained network."""

import json
import shutil
from dataclasses import replace

import pytest
import torch
from commands import SHORT, begun_training, edited, refused, same, trained, weights

from cloning.network import tensors
from cloning.training.options import parse
from model import REPORT, ROBUST, train

FEW = (*SHORT, "--samples-per-epoch", 40)


@pytest.fixture
def base(finished, tmp_path):
    """The model of a finished run, under another name."""
    return shutil.copy(finished[1] / "model.pt", tmp_path / "base.pt")


def test_a_program_trains_a_network_on(sample_recording, base, tmp_path):
    still = replace(REPORT, learning_rate=1e-9, epochs=1, samples_per_epoch=16, batch_size=8)
    assert train(still, sample_recording, tmp_path / "on.pt", device="cpu", from_model=base) == 0
    assert train(still, sample_recording, tmp_path / "on.pt", device="cpu", from_model=None, resume=True) == 0
    for name, values in weights(tmp_path / "on.pt").items():
        torch.testing.assert_close(values, weights(base)[name])


def set_preprocessing(path, **preprocessing):
    """Change some of the preprocessing in a model file."""
    with edited(path) as saved:
        saved["recipe"] |= preprocessing


def test_a_run_begins_with_the_weights_of_the_file_and_nothing_else_of_it(sample_recording, base, tmp_path):
    set_preprocessing(base, exposure=(80.0, 20.0))
    run = begun_training(sample_recording, "--from", base, "--output", tmp_path / "run" / "model.pt")
    run.pool.shutdown()
    assert same(run.network.state_dict(), weights(base))
    assert run.progress.number == 0 and not run.progress.history and not run.optimizer.state
    assert not run.checkpoint.resumed
    assert run.network.exposure == run.recipe.exposure == (0.0, 0.0), "as training_arguments.json says"


@pytest.mark.parametrize("recipe", [REPORT, ROBUST])
def test_a_run_keeps_the_recipe_of_the_network_that_it_begins_with(base, recipe):
    saved = torch.load(base, weights_only=True)
    del saved["digest"]
    saved["arguments"]["recipe"]["name"] = recipe.name
    earlier = {"recordings": ["data"], "seed": 0, "robust": recipe is ROBUST}  # of a version without recipes
    for arguments in (saved["arguments"], earlier):
        tensors.save(base, {**saved, "arguments": arguments})
        for option, wanted in ((), recipe), (("--robust",), ROBUST), (("--no-robust",), REPORT):
            assert parse(["--from", str(base), *option], REPORT, ROBUST).run.recipe.name == wanted.name


def test_it_keeps_the_file_also_as_its_own_output_and_is_resumed_exactly_without_it(sample_recording, base, tmp_path):
    """`model.py --from model.pt` in the folder of the earlier run, the shortest command, against a run in two parts."""
    before, parts = weights(base), tmp_path / "parts" / "model.pt"
    command = (sample_recording, *FEW, "--from", base)
    printed = trained(*command, "--epochs", 1, "--output", parts)
    assert f"begins with the weights of {base}" in printed
    assert "may have been trained on this run's validation frames" in printed, "with other recordings, on all of them"
    trained(*command, "--output", base)
    assert same(weights(tmp_path / "base-previous.pt"), before)
    whole = base.rename(tmp_path / "whole.pt")
    assert not same(weights(whole), before)
    told = f"the run began with --from {str(base)!r}, not 'other.pt'"
    assert told in refused("--resume", "--from", "other.pt", "--output", parts)
    assert "resumed in epoch 2" in trained("--epochs", 2, "--resume", "--output", parts)
    assert same(weights(whole), weights(parts))
    for output in (whole, parts):
        assert json.loads(output.with_name("training_arguments.json").read_bytes())["from_model"] == str(base)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda path: path.unlink(), "no such file"),
        (lambda path: set_preprocessing(path, crop=(50, 35)), "its preprocessing is not that of this program"),
    ],
)
def test_an_unusable_file_is_named_before_anything_is_written(sample_recording, base, tmp_path, change, words):
    change(base)
    told = refused(sample_recording, *FEW, "--from", base, "--output", tmp_path / "run" / "model.pt")
    assert f"model.py: {base}: " in told and words in told and "name a" in told
    assert not [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
