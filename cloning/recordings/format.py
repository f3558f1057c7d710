"""The format of the simulator's recordings and of the frames that driving saves, for all that read or write them."""

from datetime import datetime

DRIVING_LOG = "driving_log.csv"
IMAGE_FOLDER = "IMG"  # next to the csv
# Also next to it, in recordings of the stand-in simulator, which knows where the car is: see `cloning/lane/known.py`.
LANE_FILE = "lane.csv"
LANE_COLUMNS = ("center image", "lateral offset (m)", "heading error (radians)")
CAMERAS = ("center", "left", "right")  # in the order of a row's images
NUMBERS = ("steering", "throttle", "brake", "speed")
COLUMNS = (*CAMERAS, *NUMBERS)
# Of the numbers that the simulator writes: only steering has a sign. The car reaches 30 mph, on a slope a little more.
RANGES = {"steering": (-1, 1), "throttle": (0, 1), "brake": (0, 1), "speed": (0, 100)}
BINS = 41  # of a histogram of steering, from -1 to 1; the middle one is around 0
SAMPLE_RATE = 15  # rows a second
DRIVE_GAP = 1.0  # s: rows further apart are of different drives
# Training repeats a recording whose name ends like this, as the report does with problem areas.
PROBLEM_AREAS = "-repetitive", "-corrections"
TIME_STAMP = "%Y_%m_%d_%H_%M_%S_%f"  # in the names of images, with milliseconds in place of microseconds
STAMP_LENGTH = 23  # characters of yyyy_MM_dd_HH_mm_ss_fff
MAX_NAME = 255  # bytes of a file's name
LFS_POINTER = b"version https://git-lfs"  # so a file begins that Git LFS has not yet put in its place
NOT_PULLED = "a pointer of Git LFS: run `git lfs pull`"


def time_stamp(moment: datetime) -> str:
    """Return a moment as the names of images contain it, for example 2018_07_16_17_11_43_382."""
    return moment.strftime(TIME_STAMP)[:-3]


def parse_time_stamp(text: str) -> datetime:
    """Return the moment of a time stamp. Raises ValueError, for example for a thirteenth month."""
    return datetime.strptime(text + "000", TIME_STAMP)
