"""Fixtures that several files of tests share."""

import functools
import os
import shutil
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
import real_recordings
import torch
import warm
from browser import chromium
from commands import SHORT, finished_run
from rendered import render_frame, render_recording
from scenes import recorded

from cloning.network.network import Network, load_model, save_model
from cloning.recordings.images import decode
from cloning.recordings.log import Recording
from cloning.road.track import Track
from simulator import scenery


def pytest_configure(config):
    """Ctrl-C reaches the commands that tests start, even if the tests run in a shell's background, which ignores it.

    Here PyTorch computes in one thread: those of several processes would wait for each other.
    """
    torch.set_num_threads(1)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if warm.FORKS and not hasattr(config, "workerinput"):  # once for all workers of pytest
        warm.start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """Where all can be installed, as on GitHub, a skipped test fails unless it lacks recordings, a GPU or Dask."""
    report = yield
    why = str(report.longrepr)
    if (
        os.environ.get("NO_SKIPS")
        and report.skipped
        and not any(lacking in why for lacking in (real_recordings.MISSING, "a GPU", "'distributed'"))
    ):
        report.outcome = "failed"
    return report


@pytest.fixture(scope="session", autouse=True)
def shared_cache(tmp_path_factory):
    """Fixtures that several tests share write no checked images into the user's cache folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def built_once():
    """The scenery of a track that has a name is built once in a process; nothing changes it."""
    build, once = scenery.build, functools.lru_cache(8)(scenery.build)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenery, "build", lambda road, look=0: (once if isinstance(road, str) else build)(road, look))
        yield


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    """Each test has a cache of checked images of its own, empty at first."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


@pytest.fixture
def longest_file():
    """A function that sets how many bytes a file may have, as where the disk is full then; without a number, any."""
    resource = pytest.importorskip("resource", reason="this system has no limit on the size of files")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size=before[0]: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="session")
def sample_recording(tmp_path_factory) -> Path:
    """A recording of 60 rows; not to be changed."""
    return render_recording(tmp_path_factory.mktemp("data") / "lake sample")


@pytest.fixture(scope="session")
def lake_drive(tmp_path_factory) -> tuple[Recording, np.ndarray]:
    """A drive on the lake, and the true lateral offset of each row, m; not to be changed."""
    return recorded(tmp_path_factory.mktemp("recorded") / "lake", Track("lake"), 0.12, 30)


@pytest.fixture
def copied(sample_recording, tmp_path) -> Path:
    """A recording of 60 rows that a test may change."""
    return shutil.copytree(sample_recording, tmp_path / "data" / "lake")


@pytest.fixture
def linked(sample_recording, tmp_path) -> Path:
    """A recording of 60 rows whose images are links, which a test may change."""
    folder = tmp_path / "data" / "lake"
    shutil.copytree(sample_recording / "IMG", folder / "IMG", copy_function=os.link)
    shutil.copy(sample_recording / "driving_log.csv", folder)
    return folder


@pytest.fixture(scope="module")
def network() -> Network:
    """A network with random weights."""
    torch.manual_seed(3)
    return Network().eval()


@pytest.fixture(scope="session")
def model_file(tmp_path_factory) -> Path:
    """A model file with random weights."""
    torch.manual_seed(3)
    network = Network()
    torch.nn.init.normal_(network.get_parameter("dense.3.weight"), std=3)  # so that the frames' steering differs
    path = tmp_path_factory.mktemp("model") / "model.pt"
    save_model(path, network)
    return path


@pytest.fixture(scope="session")
def jpegs() -> list[bytes]:
    """Eight frames as the simulator sends them."""
    rng = np.random.default_rng(0)
    return [cv2.imencode(".jpg", render_frame(np.sin(n), 0, rng))[1].tobytes() for n in range(8)]


@pytest.fixture(scope="session")
def steering(model_file, jpegs) -> list[np.float32]:
    """The network's steering for the same JPEGs, without drive.py."""
    network = load_model(model_file)
    with torch.inference_mode():
        return [network(torch.from_numpy(decode(jpeg))[None])[0].clamp(-1, 1).numpy()[()] for jpeg in jpegs]


@pytest.fixture(scope="session")
def finished(sample_recording, tmp_path_factory) -> tuple[str, Path]:
    """A run of two epochs as in the report: what it printed, and its folder; not to be changed."""
    return finished_run(sample_recording, tmp_path_factory.mktemp("my run"), *SHORT)


@pytest.fixture
def at_once(monkeypatch):
    """A program that hangs up is not waited for, so that others are waited for as long as a busy machine takes."""

    def gone(joined, error):
        raise joined.no_answer()

    monkeypatch.setattr("simulator.join.Joined.count_reconnection", gone)


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def page(browser):
    """A page of Chromium, empty at first; afterwards it asks no server for anything any more."""
    browser.look(1280, 900)
    yield browser
    browser.empty()
