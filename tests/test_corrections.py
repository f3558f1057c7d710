"""Corrections: where the expert takes over from a server, what is recorded of it, and the same by hand."""

import itertools
import re
from types import SimpleNamespace

import numpy as np
import pytest
from steer_server import STEER, Blank, Server, ahead, unused_port
from test_simulator_window import pad_of

from cloning.base.errors import RecordingError
from cloning.recordings.format import DRIVE_GAP
from cloning.recordings.log import read_recording
from cloning.road.motion import stretches
from cloning.road.track import Track
from cloning.wire.client import MANUAL_TELEMETRY
from simulator import window
from simulator.__main__ import main
from simulator.client import RemoteDriver
from simulator.controls import Controls
from simulator.correct import TOO_FAR, CorrectedClient
from simulator.expert import Expert
from simulator.run import Run
from simulator.window import Window

STEERS = 0.08  # to the right, all the time


def to_the_right(packet, n):
    return ['42["manual",{}]' if packet == MANUAL_TELEMETRY else STEER % (str(STEERS), "0.5")]


def corrected(folder, server, laps):
    return main(["correct", str(folder), "--laps", str(laps), "--speed", "15", "--port", str(server.port)])


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive along the lake with some corrections: what was sent, printed and recorded, and the exit status."""
    folder = tmp_path_factory.mktemp("data") / "lake-corrections"
    sent = SimpleNamespace(offsets=[], printed="")
    with Server(to_the_right) as server, pytest.MonkeyPatch.context() as patch:
        update, expert_time = CorrectedClient.next_frame, {}

        def noted(client):
            packet = update(client)
            sent.offsets.append((client.correcting, client.run.offset))
            expert_time["share"] = client.expert_time / max(client.run.time, 0.02)
            return packet

        patch.setattr(CorrectedClient, "next_frame", noted)
        patch.setattr("builtins.print", lambda text: setattr(sent, "printed", f"{sent.printed}{text}\n"))
        sent.status = corrected(folder, server, 0.08)
        sent.messages = [text for text in server.messages if text.startswith("42")]
    sent.recording, sent.share = read_recording(folder), expert_time["share"]
    return sent


def test_the_expert_takes_over_a_metre_off_the_centre_and_brings_the_car_back(drive):
    by_expert = np.array([correcting for correcting, _ in drive.offsets])
    offsets = np.abs([offset for _, offset in drive.offsets])
    begins = np.flatnonzero(np.diff(by_expert.astype(int)) == 1) + 1
    ends = np.flatnonzero(np.diff(by_expert.astype(int)) == -1) + 1
    assert len(begins) >= 2
    assert (offsets[begins] > TOO_FAR).all() and (offsets[begins] < TOO_FAR + 0.3).all()
    assert (offsets[~by_expert] <= TOO_FAR).all()
    assert (offsets[ends] < 0.3).all()  # on a nearly straight road
    assert drive.status == 0 and "departures: 0" in drive.printed


def test_only_what_the_expert_drives_is_recorded(drive):
    """A row for each frame whose telemetry is null, as while a person drives; none has the server's steering."""
    rows = len(drive.recording)
    manual = drive.messages.count(MANUAL_TELEMETRY)
    assert rows in (manual, manual - 1)  # the drive may end in a correction
    assert STEERS not in drive.recording.steering.round(6)
    first = np.flatnonzero(np.r_[True, np.diff(drive.recording.time) > DRIVE_GAP])
    assert (drive.recording.steering[first] < 0).all(), "it steers back to the left at once"
    assert (drive.recording.throttle == 1).all(), "no row that the report's threshold would drop"


def test_each_correction_is_a_drive_of_its_own(drive):
    pauses = np.diff(drive.recording.time)
    assert ((pauses < 0.1) | (pauses > DRIVE_GAP)).all()
    count = int(re.findall(r"corrections: (\d+)", drive.printed)[0])
    assert (pauses > DRIVE_GAP).sum() + 1 == count
    assert len(stretches(drive.recording)) >= count - 1, "--robust can use all, but the last if the drive ended in it"


def test_the_report_says_how_much_the_expert_drove(drive):
    share = float(re.findall(r"the expert drove (\S+) % of the time", drive.printed)[0])
    assert share == pytest.approx(100 * drive.share, abs=0.5)
    assert 0.2 < drive.share < 0.9
    assert f"{len(drive.recording)} rows in " in drive.printed


def test_a_name_that_training_would_not_repeat_is_refused(tmp_path, capsys):
    assert main(["correct", str(tmp_path / "jungle-corrections-2")]) == 2
    assert "only if the folder's name ends in -repetitive or -corrections" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_without_a_correction_or_a_server_there_is_no_recording(tmp_path, capsys):
    folder = tmp_path / "x-corrections"
    with Server(ahead) as server:
        assert corrected(folder, server, 0.005) == 0
    assert "corrections: 0, the expert drove 0.0 % of the time; nothing was recorded" in capsys.readouterr().out
    assert not folder.exists()
    assert main(["correct", str(folder), "--wait", "0.1", "--port", str(unused_port())]) == 2
    assert not folder.exists()


def test_a_car_that_leaves_the_road_despite_the_expert_is_set_back(tmp_path, capsys, monkeypatch):
    """The server hangs up once in the middle of a correction, of which each row is recorded once nevertheless."""
    monkeypatch.setattr(Expert, "drive", lambda expert, run: (1.0, 1.0))
    manual = itertools.count()

    def hangs_up(packet, n):
        return None if packet == MANUAL_TELEMETRY and next(manual) == 2 else to_the_right(packet, n)

    with Server(hangs_up, sessions=2) as server:
        assert corrected(tmp_path / "x-corrections", server, 0.02) == 1
    assert (np.diff(read_recording(tmp_path / "x-corrections").time) > 0).all()
    printed = capsys.readouterr().out
    departures, corrections = (int(re.findall(rf"{word}: (\d+)", printed)[0]) for word in ("departures", "corrections"))
    assert departures >= 1 and corrections in (departures, departures + 1), "a departure ends a correction"


# ----------------------------------------------------------------------------------------------------------------------
# By hand


class Remote(RemoteDriver):
    """A server that drives straight on."""

    def poll(self, by_hand, run):
        self.throttle = 1.0


class Seat(Window):
    """The window's driving without a window: the keys are set by the test, the cameras see nothing."""

    def __init__(self, folder):
        self.simulation, self.controls = Run(Track("lake"), "autonomous"), Controls()
        self.gamepad = pad_of()
        self.remote = Remote("127.0.0.1", 1, Blank())
        self.by_hand, self.started, self.cameras, self.keys = False, True, Blank(), set()
        self.folder, self.recording, self.recording_on = folder, None, False
        self.simulated_until, self.departures, self.slow = 0.0, 0, 0

    def held(self):
        return self.keys

    def mouse(self):
        return None

    def show(self, by_hand):
        pass

    def ticks(self, seconds, monkeypatch):
        """Let so many seconds pass, in frames of a tenth."""
        for _ in range(round(10 * seconds)):
            now = self.simulated_until + 0.1
            monkeypatch.setattr(window.time, "monotonic", lambda now=now: now)
            self.tick(SimpleNamespace(cont=1))


def test_the_window_records_only_what_the_person_drives(tmp_path, monkeypatch):
    rows, begun = [], list[object]()

    def write_row(recording, cameras, run):
        rows.append((recording.start.timestamp() + run.time, run.steering))
        recording.rows += 1

    monkeypatch.setattr(window, "write_row", write_row)
    seat = Seat(tmp_path / "x-corrections")
    monkeypatch.setattr(seat.cameras, "disturb", begun.append)
    seat.act("record")
    seat.ticks(1, monkeypatch)
    assert not rows, "drive.py drives"
    for keys in ({"w", "d"}, set(), {"w", "a"}, set()):
        seat.keys = keys
        seat.ticks(0.5, monkeypatch)
    seat.finish()
    times, steering = np.array(rows).T
    assert len(rows) in (14, 15, 16), "two halves of a second"
    assert len(begun) == 3, "late frames are none of the drive before"
    assert (np.diff(times) > DRIVE_GAP).sum() == 1 and steering.any()
    assert steering[times < times[0] + 0.6].min() > 0 > steering[-3:].max()


def test_the_window_refuses_a_name_for_corrections_that_training_would_not_repeat(tmp_path):
    with pytest.raises(RecordingError, match="name it driven-corrections"):
        Window(Track("lake"), tmp_path / "driven", server=("127.0.0.1", 1))
