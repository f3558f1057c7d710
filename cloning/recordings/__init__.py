"""Recordings: `driving_log.csv` and the images of `IMG/`, read, checked and written."""
