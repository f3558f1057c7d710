"""Replay: plays real recordings as if a model were driving, and scores the drive."""
