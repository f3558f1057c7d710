"""Recordings as data sets of LeRobot, and LeRobot's data sets and donkeycar's tubs as recordings."""

TASK = "Follow the road."  # of every episode and environment; policies that read are given it
