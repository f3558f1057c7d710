"""What other people's programs need of the recordings and data sets that are written here."""

import csv
from collections import Counter
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pytest
from scenes import Here

from cloning.base.errors import RecordingError
from cloning.lerobot.dataset import write_data_set
from cloning.lerobot.source import Sample, write_recording
from cloning.recordings.format import CAMERAS, COLUMNS, NUMBERS
from cloning.recordings.images import read_frame
from cloning.recordings.log import Recording, read_recording
from cloning.recordings.part import write_part
from cloning.road.track import Track
from simulator import __main__ as command
from simulator import record


def exported(recording: Recording, folder: Path) -> None:
    write_part([recording], folder)


def converted(recording: Recording, folder: Path) -> None:
    rows = range(len(recording))
    numbers = [{name: float(getattr(recording, name)[row]) for name in NUMBERS} for row in rows]
    images = [[read_frame(recording.path(row, camera)) for camera in range(len(CAMERAS))] for row in rows]
    samples = [Sample(*each) for each in zip(recording.time.tolist(), images, numbers, strict=True)]
    write_recording(iter(samples), folder, 1.0, Counter())


@pytest.fixture(params=[exported, converted])
def write(request):
    return request.param


def assert_same(written: Recording, recording: Recording) -> None:
    for name in (*NUMBERS, "time"):
        np.testing.assert_array_equal(getattr(written, name), getattr(recording, name))
    assert not written.rejected


def test_other_programs_read_a_written_log_as_the_simulators(write, linked, tmp_path, monkeypatch):
    """With csv.reader or pandas, a line for a row: with the path as it is, or its last part, however it is split."""
    monkeypatch.chdir(tmp_path)
    recording = read_recording(linked).take(slice(4))
    for folder in (Path("part"), tmp_path / "Doe, John"):
        write(recording, folder)
        with open(folder / "driving_log.csv", encoding="utf-8") as file:
            rows = list(csv.reader(file))
        table = pd.read_csv(folder / "driving_log.csv", names=list(COLUMNS)).to_numpy().tolist()
        for at, row in enumerate(rows):
            for name, by_csv, by_pandas in zip(NUMBERS, row[3:], table[at][3:], strict=True):
                assert np.float32(by_csv) == np.float32(by_pandas) == getattr(recording, name)[at]
            images = [folder.absolute() / "IMG" / recording.name(at, camera) for camera in range(3)]
            assert row[:3] == table[at][:3] == [str(image) for image in images]
            assert all(image.is_file() for image in images)
        assert len(rows) == len(table) == 4
        written = read_recording(folder)
        assert_same(written, recording)
        assert not written.repairs


@pytest.mark.parametrize("changed", [{"speed": 40}, {"throttle": 0, "brake": 0.5}, {"throttle": 0.5, "brake": 0.5}])
def test_numbers_that_the_simulator_never_writes_have_a_header(write, changed, linked, tmp_path):
    """Without it they would be refused: they may be other columns or units."""
    values = {name: np.full(4, value, np.float32) for name, value in changed.items()}
    recording = read_recording(linked).take(slice(4), **values)
    write(recording, tmp_path / "part")
    assert (tmp_path / "part/driving_log.csv").read_text(encoding="utf-8").startswith(",".join(COLUMNS) + "\n")
    assert_same(read_recording(tmp_path / "part"), recording)


def test_the_films_of_a_data_set_can_be_cut_into_episodes_without_decoding_them(linked, tmp_path):
    """As Rerun does, which shows no episode of other films without FFmpeg; those of LeRobot's own are so, too."""
    recording = read_recording(linked)
    write_data_set([recording.take(slice(7)), recording.take(slice(7, 20))], tmp_path / "set")
    for path in (tmp_path / "set").rglob("*.mp4"):
        with av.open(str(path)) as film:
            packets = [packet for packet in film.demux(video=0) if packet.size]
        shown = [packet.pts or 0 for packet in packets]
        assert shown == sorted(shown) == [packet.dts for packet in packets] and len(shown) == 20  # in decoding order
        assert packets[0].is_keyframe and packets[7].is_keyframe and not packets[6].is_keyframe


def test_images_of_several_recordings_fit_into_one_folder(tmp_path, monkeypatch):
    """Where programs copy them, after `cat */driving_log.csv`: no name of the simulator's, a time, is there twice."""
    monkeypatch.setattr(record, "started_workers", Here)
    monkeypatch.setattr(record, "_render", lambda view, transform, begins: [b"image"] * 3)

    def names(folder: str, direction: str, **options) -> list[str]:
        record.record(tmp_path / folder, Track("lake", direction), 0.004, **options)
        return sorted(path.name for path in (tmp_path / folder / "IMG").iterdir())

    recorded = [names("ccw", "ccw"), names("cw", "cw"), *(names(f"{look}", "ccw", look=look) for look in (1, 2))]
    recorded += [names("slow", "ccw", speed=20), names("seed", "ccw", seed=1)]
    assert len(set().union(*recorded)) == sum(map(len, recorded)) > 6 * 3 * 5
    assert names("again", "ccw") == recorded[0]
    starts = []

    def begun(folder, start):
        starts.append(start)
        raise RecordingError("enough")

    monkeypatch.setattr(command, "RecordingWriter", begun)
    for name in ("lake-corrections", "lake-2-corrections"):
        assert command.main(["correct", str(tmp_path / name)]) == 2
    assert len(set(starts)) == 2
