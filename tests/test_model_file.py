"""Model files and states of a run: they are whole, damage and changes are noticed, and no code in them is run."""

import copy
import random
import re
import shutil
import zipfile
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from commands import edited
from commands import refused as refused_run
from test_resume import files

from cloning.base.errors import ModelError
from cloning.network import tensors
from cloning.network.network import SHIPPED_MODEL, Network, load_model, save_model


def test_model_file_carries_what_driving_needs(network, tmp_path):
    path = tmp_path / "model.pt"
    frames = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (5, 160, 320, 3), np.uint8))
    save_model(path, network, arguments={"seed": 1})
    saved = torch.load(path, weights_only=True)
    wanted = dict(frame=(160, 320, 3), colour="RGB", crop=(60, 25), scale=127.5, offset=1.0, exposure=(0.0, 0.0))
    assert saved["recipe"] == wanted
    assert saved["arguments"] == {"seed": 1}
    assert {"torch", "opencv", "numpy", "python"} <= set(saved["versions"])
    torch.testing.assert_close(load_model(path)(frames), network(frames))


def test_a_network_without_a_name_is_not_saved(tmp_path):
    class Unnamed(Network):
        pass

    with pytest.raises(ModelError, match=r"model\.pt: Unnamed has no name in NETWORKS"):
        save_model(tmp_path / "model.pt", Unnamed())


def refused(path, words: str) -> str:
    """The message of the error with which it is not loaded."""
    with pytest.raises(ModelError, match=words) as error:
        load_model(path)
    assert str(error.value).startswith(f"{path}: ")
    return str(error.value)


@pytest.mark.parametrize(
    "content, words",
    [
        (None, "no such file"),
        (b"\x89HDF\r\n", "damaged"),
        ({"format": "other"}, "not a model of this project"),
        (torch.zeros(3), "not a model of this project"),
        ({"format": "behavioral-cloning", "version": 99}, "version 99"),
        ({"format": "behavioral-cloning", "version": 1}, "do not fit"),
    ],
)
def test_other_files_are_refused_clearly(tmp_path, content, words):
    path = tmp_path / "model.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    refused(path, words)


@pytest.fixture(scope="module")
def saved() -> dict:
    """The contents of the model file that comes with the project, as of an earlier version: without a digest."""
    contents = torch.load(SHIPPED_MODEL, weights_only=True)
    del contents["digest"]
    return contents


def test_a_file_of_another_user_is_not_to_be_trained_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(tensors, "open", Mock(side_effect=PermissionError(13, "Permission denied")), raising=False)
    assert refused(tmp_path / "model.pt", "denied").endswith("model.pt: Permission denied; make it readable")


def test_a_model_of_another_library_is_called_so(tmp_path):
    (tmp_path / "model.h5").write_bytes(b"\x89HDF\r\n")
    refused(tmp_path / "model.h5", "a model of Keras, which PyTorch can't read; .*; LEADERBOARD.md tells how others")
    refused(tmp_path / "other.h5", "no such file")
    shutil.copy(SHIPPED_MODEL, tmp_path / "model.h5")
    assert load_model(tmp_path / "model.h5"), "as of `model.py --output model.h5`"


def test_a_flipped_bit_anywhere_is_noticed_or_changes_nothing(saved, tmp_path):
    path, data, chance = tmp_path / "model.pt", SHIPPED_MODEL.read_bytes(), random.Random(1)
    anywhere = [chance.randrange(len(data)) for _ in range(40)]
    in_the_names = [chance.randrange(9000) for _ in range(20)] + [chance.randrange(-4000, 0) for _ in range(20)]
    refused = 0
    for at in anywhere + in_the_names:
        damaged = bytearray(data)
        damaged[at] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        try:
            network = load_model(path)
        except ModelError as error:
            assert str(error).startswith(f"{path}: ")
            refused += 1
        else:  # in the padding between the entries, or in a field that nothing reads
            assert all(torch.equal(value, saved["network"][name]) for name, value in network.state_dict().items())
    assert refused >= 50  # most of a file is weights


def test_a_file_without_a_digest_is_loaded_with_a_warning_and_its_checksums_are_compared(saved, tmp_path, capsys):
    path = tmp_path / "model.pt"
    torch.save(saved, path)
    for _ in range(2):
        assert torch.equal(load_model(path).state_dict()["dense.0.weight"], saved["network"]["dense.0.weight"])
    assert re.fullmatch(f".*: {path}: has no digest, .* not noticed\n", capsys.readouterr().err)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    refused(path, "checksum of model/data/10 is wrong")


@pytest.mark.parametrize("part", ["network", "recipe"])
def test_what_was_changed_after_saving_is_noticed(part, tmp_path):
    """The archive's checksums fit, since torch wrote them anew."""
    contents = torch.load(SHIPPED_MODEL, weights_only=True)
    if part == "network":
        contents["network"]["dense.3.bias"] += 1e-6
    else:
        contents["recipe"]["crop"] = (61, 24)
    torch.save(contents, tmp_path / "model.pt")
    refused(tmp_path / "model.pt", "do not match its digest")


NAME = "dense.3.weight"  # (1, 10)
# Whichever sign the features' sum has, half of the units overflow.
HUGE = torch.full((100, 4224), 1e38) * torch.tensor([1.0, -1.0]).repeat(50)[:, None]


@pytest.mark.parametrize(
    "part, value, words",
    [
        ("recipe", [1], "no preprocessing"),
        ("frame", (120, 320, 3), "frame"),
        ("colour", "BGR", "colour 'BGR'"),
        ("crop", (60, 26), "crop"),
        ("crop", (-1, 86), "crop"),
        ("crop", ("60", "25"), "crop"),
        ("scale", 0, "scale"),
        ("scale", float("nan"), "scale"),
        ("scale", True, "scale"),
        ("scale", torch.tensor(127.5), "scale"),
        ("scale", 10**400, "scale"),
        ("offset", float("inf"), "offset"),
        ("exposure", (80.0, 256.0), "exposure"),
        ("exposure", 80.0, "exposure"),
        ("network", None, "missing or unknown"),
        ("more", torch.zeros(3), "missing or unknown: 'more'"),
        (NAME, "weights", f"{NAME} is 'weights'"),
        (NAME, torch.zeros(10, 1), f"{NAME} is a tensor \\(10, 1\\)"),
        (NAME, torch.zeros(1, 10, dtype=torch.int32), "int32"),
        (NAME, torch.full((1, 10), -float("inf")), f"{NAME} contains numbers that are not finite"),
        (NAME, torch.full((1, 10), 1e200, dtype=torch.float64), f"{NAME} contains numbers that are not finite"),
        ("dense.0.weight", HUGE, "the network's steering is not finite"),
        (NAME, torch.zeros(1).expand(10**5, 10**5), "more than 30,000,000 bytes"),
        (NAME, torch.zeros(1, 10, device="meta"), "damaged"),
        (NAME, torch.zeros(1, 10).to_sparse(), "damaged"),
        ("versions", {1, 2}, "damaged"),
    ],
)
def test_unusable_contents_are_named(saved, tmp_path, part, value, words):
    contents = copy.deepcopy(saved)
    inside = {"recipe": contents["recipe"], "network": contents["network"]}
    part_of = contents if part in contents else inside["recipe" if part in contents["recipe"] else "network"]
    part_of[part] = value
    path = tmp_path / "model.pt"
    torch.save(contents, path)
    message = refused(path, words)
    assert "python model.py" in message and len(message) < 400


def test_a_small_file_never_unpacks_to_a_large_one(saved, tmp_path):
    plain, packed = tmp_path / "plain.pt", tmp_path / "packed.pt"
    torch.save(saved, plain)
    with zipfile.ZipFile(plain) as archive, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as smaller:
        for name in archive.namelist():
            smaller.writestr(name, archive.read(name))
    refused(packed, "compressed")
    doubled: list[Any] = [0]
    for _ in range(40):  # 2 ** 40 values for whoever visits all of them
        doubled = [doubled, doubled]
    once = (saved["network"]["dense.0.weight"], "x" * 100_000)  # in the file
    for history in (doubled, *([value] * 20_000 for value in once)):
        torch.save({**saved, "history": history}, packed)
        refused(packed, "more than 30,000,000 bytes")
    with open(packed, "wb") as file:
        file.truncate(2**33)  # takes no space on the disk
    refused(packed, "8,589,934,592 bytes")


def test_what_is_contained_twice_is_saved_and_loaded(tmp_path):
    """Python and torch share constants and memory as they like; no training may end at its first save for that."""
    pair, row, tensor = (60, 25), {"loss": 0.5}, torch.arange(6.0)
    contents: dict[str, list] = {"pairs": [pair, pair], "history": [row, row]}
    contents["tensors"] = [tensor, tensor, tensor[::2]]
    tensors.save(tmp_path / "shared.pt", contents)
    loaded = tensors.load(tmp_path / "shared.pt", "none")
    assert loaded["pairs"] == [pair, pair] and loaded["history"] == [row, row]
    assert [part.tolist() for part in loaded["tensors"]] == [part.tolist() for part in contents["tensors"]]


@pytest.mark.parametrize(
    "pickled, words",
    [
        (b"(" + b"}" * 3_000_000 + b"l.", "3,000,0.. bytes that are not tensors"),
        (b"}X\x01\0\0\0a" + b"]" * 50_000 + b"a" * 49_999 + b"s.", "RecursionError"),
    ],
)
def test_a_file_of_countless_or_nested_values_is_refused(tmp_path, pickled, words):
    torch.save({"a": torch.zeros(3)}, tmp_path / "good.pt")
    with zipfile.ZipFile(tmp_path / "good.pt") as good, zipfile.ZipFile(tmp_path / "bad.pt", "w") as bad:
        for name in good.namelist():
            bad.writestr(name, b"\x80\x02" + pickled if name.endswith("data.pkl") else good.read(name))
    refused(tmp_path / "bad.pt", words)


def test_code_in_a_model_file_is_not_run(tmp_path):
    class Trap:
        def __reduce__(self):
            return open, (str(tmp_path / "sprung"), "w")

    torch.save({"format": "behavioral-cloning", "version": 1, "network": Trap()}, tmp_path / "model.pt")
    refused(tmp_path / "model.pt", "damaged")
    assert not (tmp_path / "sprung").exists()


# ----------------------------------------------------------------------------------------------------------------------
# The state of a run, which --resume continues


@pytest.fixture
def begun(finished, tmp_path):
    """The folder of a run of two epochs, that a test may change."""
    return shutil.copytree(finished[1], tmp_path / "begun")


def set_average(name, value):
    return lambda saved: saved["training"]["optimizer"]["state"][3].__setitem__(name, value)


def set_position(name, value):
    return lambda saved: saved["training"].__setitem__(name, value)


@pytest.mark.parametrize(
    "change, words",
    [
        (set_average("exp_avg", torch.full((36,), torch.nan)), "exp_avg contains numbers that are not finite"),
        (set_average("exp_avg_sq", torch.zeros(35)), "exp_avg_sq is a tensor (35,)"),
        (set_average("step", 3.0), "step is 3.0"),
        (lambda saved: saved["training"].pop("optimizer"), "optimizer's state"),
        (set_position("optimizer", {"state": {}}), "optimizer's state"),
        (set_position("number", -1), "number is -1"),
        (set_position("images", "4"), "images is '4'"),
        (set_position("fingerprint", torch.zeros(2)), "other recordings"),
        (lambda saved: saved.update(training=3), "no state"),
        (lambda saved: saved.update(history=[1]), "history"),
        (lambda saved: saved["history"][0].update(val_loss="low"), "val_loss is 'low'"),
        (lambda saved: saved["history"][0].pop("images"), "history"),
        (lambda saved: saved.update(run=[1]), "identifier"),
        (lambda saved: saved.update(arguments=None), "no arguments"),
        (lambda saved: saved["arguments"]["recipe"].update(batch_size="8"), "--batch-size is of type str"),
        (lambda saved: saved["arguments"].update(recordings=[1]), "--recordings is of type list"),
        (lambda saved: saved["arguments"]["recipe"].update(optimizer="sgd"), "optimizer is 'sgd', not adam or muon"),
        (lambda saved: saved["arguments"]["recipe"].update(turn=(0.2,)), "turn is (0.2,), not 2 numbers"),
        (lambda saved: saved["arguments"]["recipe"].update(views="Others"), "views is 'Others', not CameraViews"),
        (lambda saved: saved["arguments"]["recipe"].update(name="mine"), "recipe is 'mine', not report or robust"),
        (lambda saved: saved["arguments"].pop("recipe") and saved["arguments"].update(loss="cubed"), "loss is 'cubed'"),
        (lambda saved: saved.update(layers="other"), "not nvidia (your own belong in network.py: see "),
        (lambda saved: saved["recipe"].update(crop=(61, 24)), "its preprocessing is not"),
        (lambda saved: saved["recipe"].update(scale=0), "scale 0"),
        (lambda saved: saved["network"].update({"dense.3.bias": torch.full((1,), torch.inf)}), "not finite"),
    ],
)
def test_an_unusable_state_is_named(begun, change, words):
    path = begun / "model-resume.pt"
    with edited(path) as saved:
        change(saved)
    before = files(begun)
    told = refused_run("--output", begun / "model.pt", "--resume", "--epochs", 3)
    assert f"model.py: {path}: " in told and words in told and "new run without --resume" in told
    assert files(begun) == before
