"""Behavioral cloning: what the commands model.py, drive.py and video.py and the stand-in simulator are made of."""
