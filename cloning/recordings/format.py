"""What the simulator's recordings are made of: the facts that reading, checking and writing them share."""

LOG = "driving_log.csv"
CAMERAS = ("center", "left", "right")  # in the order of a row's images
COLUMNS = (*CAMERAS, "steering", "throttle", "brake", "speed")
RANGES = {"steering": (-1, 1), "throttle": (-1, 1), "brake": (-1, 1), "speed": (-100, 100)}  # the car does 30 mph
SAMPLE_RATE = 15  # rows a second
FRAME = (160, 320, 3)  # rows, columns, RGB of a camera's image
