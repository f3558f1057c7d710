"""The lane: lateral offset and heading, estimated from camera frames."""
