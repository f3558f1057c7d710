"""The format of the simulator's recordings: what reading, checking and writing them share."""

LOG = "driving_log.csv"
CAMERAS = ("center", "left", "right")  # in the order of a row's images
NUMBERS = ("steering", "throttle", "brake", "speed")
COLUMNS = (*CAMERAS, *NUMBERS)
RANGES = {"steering": (-1, 1), "throttle": (-1, 1), "brake": (-1, 1), "speed": (-100, 100)}  # the car reaches 30 mph
SAMPLE_RATE = 15  # rows a second
FRAME = (160, 320, 3)  # rows, columns, RGB of a camera's image
