"""Foul weather and faulty cameras: deterministic, stronger by strength, and lasting where they last."""

import numpy as np
import pytest

from cloning.recordings.images import decode
from cloning.road.disturbances import HELD_OUT, KINDS, Disturbance, Disturber, disturb

IMAGE_KINDS = [kind for kind in KINDS if kind not in ("dropped", "late")]


@pytest.fixture(scope="module")
def frames(sample_recording):
    return [decode(path.read_bytes()) for path in sorted((sample_recording / "IMG").glob("center*.jpg"))[:12]]


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_disturbs_a_drive_in_the_same_way(kind, frames):
    first, second = ([*map(Disturber(Disturbance(kind, 4), 7), frames)] for _ in range(2))
    assert all(np.array_equal(one, other) for one, other in zip(first, second, strict=True))
    assert all(seen.dtype == np.uint8 and seen.shape == frames[0].shape for seen in first)


@pytest.mark.parametrize("kind", IMAGE_KINDS)
def test_a_stronger_disturbance_leaves_less_of_the_frame(kind, frames):
    before = frames[0].copy()

    def likeness(strength):
        seen = [disturb(before, Disturbance(kind, strength), seed) for seed in range(6)]
        if kind == "underexposed":  # what is lost is its steps
            return len(np.unique(seen[0]))
        return np.mean([np.corrcoef(before.ravel(), each.ravel())[0, 1] for each in seen])

    mild, middling, strong = map(likeness, (1, 3, 5))
    assert mild > middling > strong
    assert np.array_equal(before, frames[0]), "the frame itself is not changed"


def test_strength_3_is_that_of_the_benchmarks(frames):
    """Hendrycks and Dietterich's and perturbation-drive's: contrast 0.2, JPEG 15, discs of 6, noise 0.18 to 0.22."""
    grey = np.full((160, 320, 3), 128, np.uint8)
    assert disturb(grey, Disturbance("noise", 3), 0).std() / 255 == pytest.approx(0.2, abs=0.02)
    seen = disturb(frames[0], Disturbance("contrast", 3), 0)
    assert seen.std((0, 1)) / frames[0].std((0, 1)) == pytest.approx(0.2, abs=0.02)
    dot = np.zeros((160, 320, 3), np.uint8)
    dot[80, 160] = 255
    spread = np.argwhere(disturb(dot, Disturbance("defocus", 3), 0)[..., 0])
    assert np.ptp(spread, axis=0).tolist() == [12, 12]
    assert KINDS["jpeg"].strengths[2] == 15


def test_drops_and_dirt_stay_where_they_are_and_rain_falls():
    grey = np.full((160, 320, 3), 128, np.uint8)
    for kind, stays in (
        ("dirt", True),
        ("occluded", True),
        ("fog", True),
        ("sun", True),
        ("rain", False),
        ("noise", False),
    ):
        disturber = Disturber(Disturbance(kind, 3), 5)
        assert np.array_equal(disturber(grey), disturber(grey)) == stays, kind
    other = Disturber(Disturbance("dirt", 3), 6)(grey)
    assert not np.array_equal(Disturber(Disturbance("dirt", 3), 5)(grey), other), "another drive has other dirt"


def test_frames_come_late_or_not_at_all(frames):
    late = [*map(Disturber(Disturbance("late", 3)), frames)]
    assert all(np.array_equal(seen, frames[max(0, i - 3)]) for i, seen in enumerate(late))
    dropped = Disturber(Disturbance("dropped", 3), 1)
    numbered = [np.full((4, 4, 3), i % 256, np.uint8) for i in range(2000)]
    seen = np.array([dropped(frame)[0, 0, 0] for frame in numbered])
    shown = np.array([frame[0, 0, 0] for frame in numbered])
    assert np.mean(seen != shown) == pytest.approx(0.6, abs=0.03)
    assert seen[0] == 0


def test_a_third_of_the_kinds_is_held_out():
    assert set(HELD_OUT) < set(KINDS)
    assert len(HELD_OUT) >= len(KINDS) // 3


@pytest.mark.parametrize("text", ["fog", "fog:0", "fog:6", "fog:x", "smog:3", "fog:3:1", ""])
def test_what_is_no_disturbance_is_refused(text):
    with pytest.raises(ValueError, match=r"is not KIND:STRENGTH, such as fog:3; kinds: rain, fog"):
        Disturbance.parse(text)
    assert str(Disturbance.parse("fog:3")) == "fog:3"
