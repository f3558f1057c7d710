"""Lane: estimates lateral offset and heading from camera frames, and locates a drive on a known track."""
