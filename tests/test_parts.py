"""Which rows of a damaged recording are placed on a known track, from detections whose truth geometry tells."""

from collections.abc import Iterable

import numpy as np
import pytest
from rendered import without_files

from cloning.lane.ahead import centre_ahead
from cloning.lane.cuts import find_cuts
from cloning.lane.follow import Candidate, TrackFilter, short_of_bend
from cloning.lane.localise import _pieces, cameras_exchanged, localise_all, steers_against_bends
from cloning.lane.parts import EXPECTED, Placing, certain_parts, unrivalled
from cloning.lane.reader import DISTANCES_AHEAD, MOUNT_OFFSETS, fuse_detections
from cloning.lane.recovery import MISHAP, LanePosition
from cloning.lane.search import ALONG, MIN_LOG_LIKELIHOOD, Localisation, Part, followed, known_tracks, search
from cloning.recordings.log import Recording
from cloning.road.camera import camera_position
from cloning.road.motion import MPH, YAW_LAG, Stretch, steering_for, stretches
from cloning.road.track import ROADS, Track

PAUSE = 0.0714  # s between rows


def driven(
    name: str, rows: int, start: float = 30.0, mph: float = 25, direction: str | None = None
) -> tuple[Recording, np.ndarray]:
    """A drive along a track's centre, and what a network detects on it to 0.15 m: float32 (n, 3, 5)."""
    track, recording = Track(name, direction), without_files(rows, seconds=PAUSE, speed=mph)
    along = start + np.cumsum(np.r_[0, np.full(rows - 1, mph * MPH * PAUSE)])
    bends = [track.curvature[track.index(s + YAW_LAG * mph * MPH)] for s in along]
    recording.steering[:] = steering_for(np.array(bends))
    centres = []
    for s in along:
        at = track.at(s)
        camera = camera_position(np.array([at.x, at.y]), np.array([np.cos(at.heading), np.sin(at.heading)]))
        centres.append(centre_ahead(track, s, camera, at.heading))
    noise = np.random.default_rng(0).normal(0, 0.15, (rows, len(DISTANCES_AHEAD)))
    seen = np.array(centres)
    for hidden in range(1, len(DISTANCES_AHEAD)):  # a network detects that the road turns away
        seen[:, hidden] = np.where(np.isnan(seen[:, hidden]), 1.2 * seen[:, hidden - 1], seen[:, hidden])
    return recording, ((seen + noise)[:, None] - MOUNT_OFFSETS[:, None]).astype(np.float32)


def offset_of(rows: int, parts: Iterable[tuple[slice, Localisation]]) -> np.ndarray:
    """The lateral offset of each row, m, which is 0 in truth; nan where it is not placed."""
    offset = np.full(rows, np.nan)
    for part, found in parts:
        offset[part] = found.middle()[:, 0]
    return offset


def placed(recording: Recording, centres: np.ndarray) -> np.ndarray:
    parts = certain_parts(recording, stretches(recording), centres)
    return offset_of(len(recording), ((part.rows, found) for part, found in parts))


def localised(stretch: Stretch, centres: np.ndarray) -> Localisation:
    """A whole stretch on the track and direction that it fits best."""
    found = search([TrackFilter(stretch, centres, track) for track in known_tracks()], 0, len(stretch))
    return followed(found[0], len(stretch))


def check(offset: np.ndarray, undamaged: np.ndarray) -> None:
    assert np.mean(~np.isnan(offset[undamaged])) > 0.98
    assert np.nanmean(np.abs(offset[undamaged])) < 0.12  # measured: 0.03 to 0.09


@pytest.mark.parametrize("name", ["lake", "jungle", "road-1", "road-4", "road-16", "road-20"])
def test_no_road_is_taken_for_a_known_one(name):
    """315 m along a road's centre: the lake fits these roads' detections nearly as well."""
    recording, centres = driven(name, 395)
    [stretch] = stretches(recording)
    found = localised(stretch, centres)
    assert found.log_likelihood > MIN_LOG_LIKELIHOOD
    assert found.is_certain() == (name in ROADS)
    if name in ROADS:
        assert found.track.name == name and np.abs(found.states[:, 1]).mean() < 0.17  # measured: 0.03 and 0.14


@pytest.mark.parametrize("pause", [3, 60])  # s: after a minute the car may be anywhere
def test_an_s_bend_after_a_pause_is_not_driven_the_wrong_way(pause):
    """From both of its ends it looks the same; by itself, the other direction was the likelier one."""
    recording, centres = driven("jungle", 701, 128, 10, "cw")
    recording = recording.take(slice(None), time=recording.time + pause * (np.arange(701) >= 400))
    parts = [(part.rows, found) for part, found in certain_parts(recording, stretches(recording), centres)]
    driven_ways = [(rows, found.track.direction) for rows, found in parts]
    assert driven_ways == [(slice(0, 400), "cw"), (slice(400, 701), "cw")]
    check(offset_of(701, parts), np.ones(701, bool))


def test_what_a_hairpin_hides_does_not_count_against_the_track():
    """It turns back 8 m ahead, to the left. A network detects something there, too: further to that side, or not."""
    seen, measured = np.array([-1.0, -3.0, -7.0]), np.array([-1.0, -3.0, -7.0, -9.0, -4.0])
    assert short_of_bend(measured, seen)[3:].tolist() == [0, 3]
    assert short_of_bend(-measured, -seen)[3:].tolist() == [0, 3]
    recording, centres = driven("jungle", 60, 665, 10, "cw")
    follower = TrackFilter(stretches(recording)[0], centres, Track("jungle", "cw"))
    assert Candidate(follower, np.array([665.0, 0, 0])).follow(60) > -0.1  # was -0.7


@pytest.fixture(scope="module")
def lake():
    return driven("lake", 640)


def test_a_car_that_is_stuck_costs_its_own_rows(lake):
    """At full lock with wheels spinning, at the start and in the middle; nothing else is lost."""
    order = np.r_[np.zeros(40, int), 0:320, np.full(50, 319), 320:640]
    undamaged = np.diff(order, prepend=-1) != 0
    undamaged[:41] = np.arange(41) == 40
    recording = lake[0].take(order, time=np.arange(len(order)) * PAUSE)
    recording.steering[~undamaged], recording.speed[~undamaged] = 1, 3
    check(placed(recording, lake[1][order]), undamaged)


def test_a_car_that_is_somewhere_else_at_once_is_found_there(lake):
    order = np.r_[0:330, 300:500, 515:640]  # pushed back by 24 m, and on by 12 m
    check(placed(lake[0].take(order, time=np.arange(len(order)) * PAUSE), lake[1][order]), np.ones(len(order), bool))


def test_a_short_stretch_is_placed_beside_a_certain_one(lake):
    recording, centres = lake
    rows = np.r_[0:400, 420:490, 505:575]
    check(placed(recording.take(rows), centres[rows]), np.ones(len(rows), bool))
    alone = np.r_[505:575]
    assert np.isnan(placed(recording.take(alone), centres[alone])).all()


def test_stretches_too_short_for_a_window_are_placed_together_or_if_long_enough_alone(lake):
    recording, centres = lake
    short = np.r_[0:100, 120:190, 210:280, 300:500, 520:590]
    check(placed(recording.take(short), centres[short]), np.ones(len(short), bool))
    long, alone = np.r_[300:540], np.r_[300:500]  # 191 m and 159 m
    check(placed(recording.take(long), centres[long]), np.ones(len(long), bool))
    assert np.isnan(placed(recording.take(alone), centres[alone])).all()
    other, seen = driven("road-9", 600)
    assert np.isnan(placed(other.take(short), seen[short])).all()


def plain(brightness):
    """Strips of one brightness in each row."""
    return lambda rows: np.tile(brightness[rows, None, None, None, None], (1, 3, 32, 160, 3))


@pytest.mark.parametrize(("rows", "pause"), [(90, PAUSE), (70, 2.0)])
def test_no_row_of_another_road_is_taken_for_the_track(lake, rows, pause):
    """It begins and ends in the midst of a recording of the track, in another light."""
    track = Track("road-9")
    other, seen = driven("road-9", rows, start=track.step * np.abs(track.curvature).argmax() - 30)  # a bend
    recordings = (lake[0].take(slice(0, 320)), other, lake[0].take(slice(320, 640)))
    pauses = np.full(640 + rows, PAUSE)
    pauses[[320, 320 + rows]] = pause
    recording = Recording.joined(recordings, time=np.cumsum(pauses))
    foreign = np.zeros(640 + rows, bool)
    foreign[320 : 320 + rows] = True
    strips = plain(np.where(foreign, 90, 60).astype(np.uint8))
    centres = np.concatenate([lake[1][:320], seen, lake[1][320:]])
    offset = offset_of(len(recording), localise_all(recording, stretches(recording), centres, strips))
    assert np.isnan(offset[foreign]).all()  # without the cut in the frames, some were taken for the lake
    check(offset, ~foreign)


@pytest.mark.parametrize(("rows", "unlike"), [(70, slice(0)), (180, slice(400, 500))])
def test_a_stretch_that_fits_only_where_the_part_before_it_ends_is_another_road(lake, rows, unlike):
    """From the end of 70 rows there was no time to come back to where the lake goes on; of 180 only the start fits."""
    order, pauses = np.r_[0:320, 347 : 347 + rows, 320:640], np.full(640 + rows, PAUSE)
    pauses[[320, 320 + rows]] = 2.0
    recording, centres = lake[0].take(order, time=np.cumsum(pauses)), lake[1][order]
    centres[unlike] = np.random.default_rng(1).uniform(-4, 4, centres[unlike].shape)
    foreign = np.r_[np.zeros(320, bool), np.ones(rows, bool), np.zeros(320, bool)]
    offset = placed(recording, centres)
    assert np.isnan(offset[foreign]).all()
    check(offset, ~foreign)


@pytest.mark.parametrize("slowest", [3, 6])
def test_rows_of_a_crash_are_cut_off_the_end_of_a_piece(lake, slowest):
    """With them it turns otherwise than it steers; without them it is certain beside another one.

    Not if the car does not stop: another road, between two cuts, would become certain without the rows that differ.
    """
    order = np.r_[0:100, np.full(10, 99), 99:79:-1]
    recording = lake[0].take(order, time=np.arange(130) * PAUSE)
    recording.steering[100:], recording.speed[100:] = 1, slowest
    placing = Placing(recording, [Stretch.of(recording, slice(0, 130))], lake[1][order])
    follower = placing.followers[0].ahead[0]
    assert (follower.track.name, follower.track.direction) == ("lake", "ccw")
    whole = Part(0, 0, 0, 130, followed(Candidate(follower, np.array([30.0, 0, 0])), 130))
    assert not whole.is_beyond(EXPECTED["lake"])
    cut = placing.without_mishaps(whole)
    if slowest == 6:
        assert cut is whole
        return
    assert cut.start == 0 and abs(cut.end - 100) < 10 and cut.is_beyond(EXPECTED["lake"])


@pytest.mark.parametrize(("away", "certain"), [(0.0, True), (-15.0, False)])
def test_a_short_piece_that_was_followed_away_from_where_the_car_should_be_is_not_certain(monkeypatch, away, certain):
    """A piece of a generated road was, 27 m back, and was taken for the jungle."""
    recording, centres = driven("lake", 100)
    track = next(i for i, each in enumerate(known_tracks()) if (each.name, each.direction) == ("lake", "ccw"))
    reach = 22.0

    def part(stretch, start):
        states = np.stack([start + 0.8 * np.arange(70.0), np.zeros(70), np.zeros(70)], axis=1)
        return Part(stretch, track, 0, 70, Localisation(known_tracks()[track], states, 0.0, 0.1))

    before = part(0, 30.0)
    found = part(1, before.found.states[-1, 0] + reach + away)
    placing = Placing(recording, stretches(recording) * 2, centres)
    monkeypatch.setattr(placing, "best_of", lambda *_: found)
    assert placing.near(before, 1, (0, 0, 70), reach, True, False) is (found if certain else None)


@pytest.mark.parametrize(("blocks", "rows", "cuts"), [(80, 1, [29]), (60, 1, []), (80, 3, [])])
def test_a_road_that_is_cut_is_told_from_one_that_changes(blocks, rows, cuts):
    """Shade comes over a part of the frames, or over all of them in successive rows."""
    colours = 100 + np.random.default_rng(0).normal(0, 3, (60, 96, 3)).astype(np.float32)
    for later in range(rows):
        colours[30 + later :, :blocks] -= 20
    assert np.flatnonzero(find_cuts(colours)).tolist() == cuts


def test_a_turn_that_the_steering_does_not_explain_ends_a_part(lake):
    """What the cameras see fits all the time."""
    steering, centres = lake[0].steering.copy(), lake[1]
    steering[400:440] += 0.15
    recording = lake[0].take(slice(None), steering=steering)
    offset = placed(recording, centres)
    undamaged = np.r_[np.ones(400, bool), np.zeros(40, bool), np.ones(200, bool)]
    check(offset, undamaged)
    assert np.isnan(offset[410:430]).all()


@pytest.mark.parametrize("cameras", [[0, 2, 1], [1, 0, 2], [2, 1, 0]])
def test_exchanged_cameras_are_told_from_where_they_see_the_lane(cameras):
    centres = driven("jungle", 60)[1]
    assert not cameras_exchanged(centres) and not cameras_exchanged(centres / 2)
    assert cameras_exchanged(centres[:, cameras]) and cameras_exchanged(-centres), "mirrored"


@pytest.mark.parametrize(("rows", "told"), [(700, True), (590, False)])
def test_steering_of_the_other_sign_is_told_from_what_the_cameras_see(rows, told):
    recording, centres = driven("jungle", rows)
    assert not steers_against_bends(recording, centres)
    assert steers_against_bends(recording.take(slice(None), steering=-recording.steering), centres) == told


def test_a_short_drive_that_turns_otherwise_than_it_steers_is_not_certain(lake):
    """Each row may be on the lake, but in 239 m the turns are too uncertain to tell it from other roads."""
    steering = lake[0].steering[:300] + np.random.default_rng(0).normal(0, 0.09, 300).astype(np.float32)
    recording = lake[0].take(slice(0, 300), steering=steering)
    assert np.isnan(placed(recording, lake[1][:300])).all()


def test_rows_of_hardly_any_metres_are_not_placed(lake):
    """As where time stamps count the frames in milliseconds."""
    recording = lake[0].take(slice(0, 300), time=np.arange(300) / 1000, speed=np.full(300, 10, np.float32))
    assert np.isnan(placed(recording, lake[1][:300])).all()


def test_of_two_parts_as_good_as_each_other_none_is_certain():
    states = np.stack([np.arange(300.0), np.zeros(300), np.zeros(300)], axis=1)
    part, near, far, worse = (
        Part(0, 0, 0, 300, Localisation(Track("lake", "ccw"), states + np.array([shift, 0, 0]), fit, 0.2))
        for shift, fit in ((0, -0.05), (5, -0.06), (50, -0.06), (50, -0.34))
    )
    assert unrivalled([part, near], ALONG) is part
    assert unrivalled([part, worse], ALONG) is part
    assert unrivalled([part, far], ALONG) is None


def test_frames_of_nothing_cost_their_own_rows_which_belong_to_no_piece(lake):
    """And the rows before and after them are two."""
    recording, centres = lake
    centres = centres.copy()
    centres[300:360] = np.random.default_rng(1).uniform(-4, 4, centres[300:360].shape)
    parts = list(localise_all(recording, stretches(recording), centres, plain(np.zeros(640, np.uint8))))
    offset = offset_of(640, parts)
    check(offset, np.r_[np.ones(300, bool), np.zeros(60, bool), np.ones(280, bool)])
    assert np.isnan(offset[310:350]).all()
    position = fuse_detections(recording, centres)
    assert isinstance(position, LanePosition) and not position.placed.any() and not position.piece.any()
    [stretch], found = stretches(recording), [rows for rows, _ in parts]
    assert not _pieces(640, [stretch], found[:1])[found[0].stop :].any(), "so many rows are another road"
    position.piece[:] = _pieces(640, [stretch], found)
    assert (position.piece[np.isnan(offset)] == MISHAP).all()
    position.piece[-20:] = 9  # too short for a piece
    found[-1] = slice(found[-1].start, 620)
    assert [each.rows for each in position.pieces(recording, stretch)] == found
