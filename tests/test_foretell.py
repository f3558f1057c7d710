"""What says that a network is out of its depth: its signs, their fit and measure, its file, and its use in drive.py."""

import numpy as np
import pytest
import torch
from rendered import render_frame, render_recording
from scipy.spatial.distance import mahalanobis

import drive
from cloning.base.errors import ModelError, UserError
from cloning.lane import foretell
from cloning.lane.foretell import ALARM, Blindness, Foreteller, Limits, Normal, Observation, Observer, Ordinary, Signs
from cloning.network.network import Network, steer
from cloning.replay import replay
from cloning.replay.model_driver import ModelDriver
from cloning.replay.replay import load_recording
from cloning.road.motion import MPH, TOP_SPEED_MPH
from tools import foretell as tool
from tools.simulator_client import telemetry


def observations(rng: np.random.Generator, rows: int, strange: float) -> Observation:
    """What is seen in a drive, ordinary if nothing is strange; as in real ones, the steering follows the lane."""
    centres = np.cumsum(rng.normal(0, 0.05 * (1 + strange), (rows, 5)), 0)
    doubt = rng.normal(0, 0.1 * (1 + strange), (rows, 5))
    steering = centres[:, 2] * 0.1 + rng.normal(0, 0.01, rows)
    activations, hidden = rng.normal(strange, 1, (rows, 12)), rng.normal(strange, 1, (rows, 96))
    values = (steering, activations, hidden, centres + doubt, -centres + doubt)
    return Observation(*(np.asarray(value, np.float32) for value in values))


@pytest.fixture(scope="module")
def ordinary() -> Ordinary:
    return Ordinary.of(observations(np.random.default_rng(0), 2000, 0))


@pytest.fixture
def limits(network) -> Limits:
    observer, rng = Observer(network), np.random.default_rng(1)
    frames = [render_frame(offset, 0.0, rng) for offset in rng.uniform(-1, 1, 12)]
    seen = Observation(*map(np.stack, zip(*map(observer, frames), strict=True)))
    return Limits(Ordinary.of(seen), np.linspace(-1, 1, 40, dtype=np.float32), np.full(20, 9, np.float32), -0.25, 0.875)


# ----------------------------------------------------------------------------------------------------------------------
# Signs


def test_the_distance_is_that_of_mahalanobis(ordinary):
    """Against SciPy's, with the covariance that made the values."""
    rng = np.random.default_rng(2)
    mixing = np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    normal, value = Normal.of(rng.normal(size=(200_000, 6)) @ mixing.T), rng.normal(size=6)
    wanted = mahalanobis(value, np.zeros(6), np.linalg.inv(mixing @ mixing.T)) / np.sqrt(6)
    assert normal.distance(value) == pytest.approx(wanted, rel=0.02)


def test_signs_are_the_same_at_any_frame_rate(ordinary):
    """What is seen changes after a second; half a second later the means have come as far at 60 frames/s as at 15."""
    seen = observations(np.random.default_rng(3), 2, 3.0)
    before, after = (Observation(*(values[at] for values in seen)) for at in (0, 1))
    found = []
    for rate in (15, 60):
        signs = Signs(ordinary)
        first = signs(before, 0.0)
        for frame in range(1, rate + 1):
            same = signs(before, frame / rate)
        assert same == pytest.approx(first, abs=1e-4)
        for frame in range(rate + 1, rate + rate // 2 + 1):
            last = signs(after, frame / rate)
        found.append(last)
    far = np.abs(np.log(np.maximum(np.abs(found[0] - first), 1e-3))) < 20  # all of them
    assert found[0][far] == pytest.approx(found[1][far], abs=0.35) and np.abs(found[0] - first).max() > 1


def test_the_observer_sees_what_the_network_steers_by_and_both_sides_alike(network):
    observe, frame = Observer(network), render_frame(0.4, 0.0, np.random.default_rng(4))
    seen = observe(frame)
    assert seen.steering == steer(network, frame)
    with torch.inference_mode():  # the last two layers make the same steering of what was kept
        x = torch.from_numpy(seen.activations)
        for layer in network.dense[1:]:
            x = layer(x) if layer is network.dense[-1] else torch.nn.functional.elu(layer(x))
    assert float(x) == pytest.approx(float(seen.steering), abs=1e-5)


def test_a_network_without_a_narrow_layer_is_watched_at_its_last_one():
    class Wide(Network):
        def layers(self):
            return super().layers()[0], [torch.nn.Linear(self.units, 512), torch.nn.Linear(512, 1)]

    seen = Observer(Wide().eval())(render_frame(0.4, 0.0, np.random.default_rng(4)))
    assert seen.activations.shape == (512,)


def test_a_camera_that_shows_nothing_new_while_the_car_drives_makes_it_blind(limits, network):
    """A standing car's frames are all alike; after a pause, of the simulator or of drive.py, one frame is no alarm."""
    blindness = Blindness()
    frames = [render_frame(offset, 0.0, np.random.default_rng(8)) for offset in (0.2, 0.3)]
    drive = [(0, 0.0, 9), (0, 0.1, 20), (0, 0.2, 20), (1, 0.3, 8), (1, 99, 10), (1, 98, 2), (1, 98.1, 0), (0, 98.2, 9)]
    found = [blindness(frames[frame].copy(), time, speed) for frame, time, speed in drive]
    assert found == pytest.approx([0, 2, 4, 0, 2, 2, 2, 0])
    foretell = Foreteller(Observer(network), limits._replace(bias=-30.0))
    risks = [foretell(frames[0].copy(), at / 10, 10.0)[1] for at in range(8)]
    assert risks == pytest.approx([0, 1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6, 1, 1], abs=1e-6), "after 3 m it is an alarm"
    foretell(frames[1], 1, 10.0)
    assert foretell(frames[1].copy(), 99, TOP_SPEED_MPH * MPH)[1] < ALARM


# ----------------------------------------------------------------------------------------------------------------------
# Fit and measure


def driven(rng: np.random.Generator, number: int, kind: str, strange: bool) -> tuple[tool.Course, tool.Drive]:
    """A drive of 30 s; one that is strange departs at its end, and what is seen becomes strange 5 s before."""
    seen, time = observations(rng, 450, 0), np.arange(450) / 15
    if strange:
        late = observations(rng, 75, 1.0)
        seen = Observation(*(np.concatenate([a[:-75], b]) for a, b in zip(seen, late, strict=True)))
    course = tool.Course(kind, "lake", number, "fog:5" if kind == tool.DISTURBED else "")
    away = 0.2 + strange * np.maximum(time - 25, 0) / 2
    return course, tool.Drive(seen, 0 * time, time, away, np.array([29.95] if strange else []))


CLEAR = (tool.ORDINARY, False), (tool.HARD, True)


def test_departures_are_foretold_on_drives_that_nothing_was_tuned_on():
    rng = np.random.default_rng(5)
    kinds = [(tool.ORDINARY, False)] * 6 + [(tool.HARD, False)] * 4 + [(tool.HARD, True), (tool.DISTURBED, True)] * 3
    kinds += [(tool.DISTURBED, False)]
    tuning, measuring = ([driven(rng, first + i, *kind) for i, kind in enumerate(kinds)] for first in (2001, 1))
    limits = tool.fit(tuning)
    assert ALARM < limits.stop < 1
    lines = tool.table(limits, measuring).splitlines()
    hard, every = (line.strip("| ").split(" | ") for line in (lines[3], lines[-1]))
    assert hard[1:3] == ["3", "100 %"] and every[1] == "6" and every[4] == "55", "5 whole windows, 11 drives"
    assert float(every[5].removesuffix(" %")) < 15 and int(every[3].removesuffix(" %")) < 25


def test_a_network_that_leaves_every_mountain_road_has_limits_and_one_that_leaves_nearly_all_is_refused():
    rng = np.random.default_rng(5)
    fair, hard = ([driven(rng, 2001 + i, kind, strange) for i in range(6)] for kind, strange in CLEAR)
    limits = tool.fit(fair + hard)
    assert ALARM < limits.stop < 1 and tool.table(limits, hard).splitlines()[3].endswith("| 100 % | 100 % | 0 |  |")
    for staying in (0, 1):
        with pytest.raises(UserError, match="leaves the road in nearly every clear drive"):
            tool.fit(fair[:staying] + hard)


def test_each_kind_of_drive_counts_the_same_for_an_alarm_and_one_odd_window_does_not_decide_on_stops():
    of_all = [np.linspace(0, 5, 900), np.append(np.linspace(-3, 0, 199), 9.0), np.linspace(-3, 0, 100)]
    for extreme in (0, 9, 90):  # windows of the first kind, with the lowest odds
        of_one = [np.full(len(each), -9.0) for each in of_all]
        of_one[0][:extreme] = 1.0
        alarm, stop = tool.thresholds(of_all, of_one)
        alarms = [(each > alarm) | (one > 0) for each, one in zip(of_all, of_one, strict=True)]
        assert np.mean([each.mean() for each in alarms]) == pytest.approx(0.04, abs=0.005)
        assert stop == pytest.approx(1 / (1 + np.exp(-tool.MARGIN)))


def test_what_is_extreme_is_told_by_enough_windows(monkeypatch):
    rng = np.random.default_rng(5)
    drives = [driven(rng, 2001 + i, tool.ORDINARY, False) for i in range(8)]  # every second one has 5 windows that tell
    assert (tool.fit(drives).extreme == tool.NEVER).all()
    monkeypatch.setattr(tool, "RARE", 0.051)
    limits = tool.fit(drives)
    signs = [part.signs[: 75 * 5] for drive in drives[1::2] for part in tool.parts(limits.ordinary, *drive)]
    greatest = np.concatenate(signs).reshape(20, 75, -1).max(1)[:, :20]
    assert limits.extreme == pytest.approx(np.sort(greatest, 0)[-2], abs=1e-5), "exceeded in one of 20"


def test_one_extreme_sign_alone_is_an_alarm(limits):
    signs = np.full(40, -9.0, np.float32)
    calm = limits._replace(weights=0 * limits.weights, bias=-30.0, extreme=np.linspace(0, 1, 20, dtype=np.float32))
    assert calm.risk(signs, 0.0) < 1e-9
    for at in (0, 19):
        signs[at] = calm.extreme[at]
        assert calm.risk(signs, 0.0) == pytest.approx(ALARM)
        signs[at] += 0.5
        assert calm.risk(signs, 0.0) == pytest.approx(1 / (1 + np.exp(-2.0)))
        signs[at] = -9.0
    signs[20:] = 9.0
    assert calm.risk(signs, 0.0) < 1e-9, "only the means over the shorter time tell alone"


def test_what_is_driven_in_a_recording_is_a_replay_in_pieces(network, tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "PIECE", 3.0)
    folder = render_recording(tmp_path / "drive", rows=120)
    recording = load_recording(folder)
    whole = replay.drive(recording, replay.reference_lines(recording), 2.5, ModelDriver(network))
    found = tool.replays(Observer(network), folder)
    assert len(found) == 3 and all(course.tunes and course.kind == tool.REPLAYED for course, _ in found)
    assert len({course.name for course, _ in found}) == 3
    seen, time, away = (
        [column(each) for _, each in found]
        for column in (lambda each: each.seen.steering, lambda each: each.time, lambda each: each.away)
    )
    assert np.concatenate(seen) == pytest.approx(np.array(whole.steering), abs=1e-6)
    assert np.concatenate(away) == pytest.approx(np.abs(whole.offset))
    assert np.concatenate(time) == pytest.approx(recording.time[whole.row])
    left = np.concatenate([each.departures for _, each in found])
    assert left == pytest.approx(recording.time[whole.row][list(whole.interventions)]) and len(left)


def test_an_alarm_counts_from_6_to_1_s_before_a_departure():
    time = np.arange(0, 20, 1 / 15)
    part = tool.Part(tool.HARD, np.zeros((len(time), 1)), 0 * time, time, time, 20.0)
    for first, last, wanted in ((13.5, 13.9, 0), (14.1, 14.3, 1), (18.8, 18.95, 1), (19.1, 20, 0)):
        assert tool.greatest(part, ((time >= first) & (time <= last)) * 1.0) == [wanted]
    assert tool.greatest(part._replace(departure=None), (time < 0.1) * 1.0) == [1, 0, 0], "whole windows of 5 s"
    late = np.array([19.5, 19.6])
    assert tool.greatest(tool.Part(tool.HARD, np.zeros((2, 1)), 0 * late, late, late, 20.0), np.ones(2)) == []


def test_what_is_fitted_is_how_far_from_the_centre_the_car_will_be():
    time = np.arange(0, 20, 1 / 15)
    part = tool.Part(tool.HARD, np.zeros((len(time), 1)), 0 * time, time, np.abs(time - 10), None)
    found = part.coming[np.searchsorted(time, [0, 5.9, 13, 18.5, 19.5])]
    assert found[:4] == pytest.approx([9, 3.1, 9, 9.9], abs=0.1) and np.isnan(found[4]), "1 to 6 s later"
    leaves, before = part._replace(departure=20.0).coming, time < 13.99
    assert (leaves[~before] == tool.OFF_ROAD).all() and (leaves[before] == part.coming[before]).all()


def test_the_regression_is_that_of_least_squares_with_a_row_more_for_each_weight():
    """Against NumPy's, on rows scaled by the root of their share; such a row pulls its weight to 0."""
    rng = np.random.default_rng(7)
    signs, away, share = rng.normal(3, 2, (300, 4)), rng.uniform(0, 4, 300), rng.dirichlet(np.ones(300))
    scaled = np.c_[(signs - signs.mean(0)) / (signs.std(0) + 1e-3), np.ones(300)] * np.sqrt(share)[:, None]
    wanted = np.log(away + tool.NEAR) * np.sqrt(share)
    pull = np.sqrt(tool.DECAY) * np.eye(4, 5)
    found = np.linalg.lstsq(np.r_[scaled, pull], np.r_[wanted, np.zeros(4)], rcond=None)[0][:4]
    assert tool.regress(signs, away, share) == pytest.approx(found / (signs.std(0) + 1e-3), rel=1e-4)


def test_what_measures_was_not_tuned_on():
    tuning, measuring = ([course for course in tool.courses() if course.tunes is tunes] for tunes in (True, False))
    assert not {course.number for course in measuring} & {course.number for course in tuning}
    assert not {c.disturbance for c in measuring} & {c.disturbance for c in tuning} - {""}
    assert len({course.name for course in tool.courses()}) == len(tool.courses())


# ----------------------------------------------------------------------------------------------------------------------
# The file


def test_limits_belong_to_one_network_and_a_damaged_file_is_refused(limits, network, tmp_path):
    model, frame = tmp_path / "my model.pt", render_frame(0.2, 0.3, np.random.default_rng(6))
    assert foretell.load_limits(model, network) is None, "no file"
    foretell.save_limits(model, network, limits)
    read = foretell.load_limits(model, network)
    assert read
    risks = [Foreteller(Observer(network), each)(frame, 0.0, 0.0)[1] for each in (limits, read)]
    assert risks[0] == risks[1] and (read.bias, read.stop) == (limits.bias, limits.stop)
    assert foretell.limits_file(model).stat().st_size < 200_000
    assert foretell.load_limits(model, Network().eval()) is None, "another network has no figure"
    foretell.save_limits(model, network, limits._replace(weights=limits.weights[:-1]))
    with pytest.raises(ModelError, match=r"model.limits.pt: .*; delete it, or .*python -m tools.foretell '.*model.pt'"):
        foretell.load_limits(model, network)


# ----------------------------------------------------------------------------------------------------------------------
# drive.py


def test_a_car_slows_down_and_stops_when_the_network_is_lost_and_a_person_may_let_it_go_on(network, limits, jpegs):
    server = drive.DriveServer(network, 20, limits=limits, stop_when_lost=True)
    session, risks = server.session("sid"), [0.0]
    session.pilot.foretell = lambda *frame: (np.float32(0), risks[0])  # type: ignore[assignment]

    def set_speed(risk: float) -> float:
        risks[0] = risk
        session.answer(telemetry(jpegs[0], speed="15.0000"))
        assert session.history[-1].risk == risk
        return session.controller.set_speed

    assert [set_speed(risk) for risk in (0.1, ALARM, 0.6875, 0.86)] == [20, 20, 10, drive.SLOWEST_MPH]
    assert set_speed(0.2) == 20
    assert set_speed(0.9) == 0 and set_speed(0.1) == 0, "it stays where it is"
    assert float(session.answer(telemetry(jpegs[0], speed="15.0000"))["throttle"]) == -1
    assert drive.page.state_of(session, session.heard) == "doubtful"
    server.change_set_speed(12)
    assert set_speed(0.95) == 12 and drive.page.state_of(session, session.heard) == "driving", "at the person's risk"
    assert [set_speed(risk) for risk in (0.3, 0.95)] == [12, 0], "until all was well for a moment"
    server.change_set_speed(0)
    assert set_speed(0.6) == 0, "a person's stop holds"


def test_without_the_option_the_risk_is_only_shown(network, limits, jpegs):
    session = drive.DriveServer(network, 20, limits=limits._replace(bias=30.0)).session("sid")
    session.answer(telemetry(jpegs[0], speed="15.0000"))
    assert (session.history[-1].risk or 0) > 0.99 and session.controller.set_speed == 20
    unknown = drive.DriveServer(network, 20).session("sid")
    unknown.answer(telemetry(jpegs[0], speed="15.0000"))
    assert unknown.history[-1].risk is None
