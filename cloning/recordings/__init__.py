"""Recordings: reads, checks and writes `driving_log.csv` and the images in `IMG/`."""
