"""The shape of a camera's image, and the part of it that shows the road."""

FRAME = (160, 320, 3)  # rows, columns, RGB
ROAD_ROWS = slice(45, 135)  # of a frame: all to which the networks and their warped views look; below is the bonnet
