"""Recordings: read, check and write `driving_log.csv`, the images in `IMG/`, and the frames that driving saves."""
