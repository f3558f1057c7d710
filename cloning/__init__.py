"""Behavioral cloning: the code shared by model.py, drive.py, video.py and the stand-in simulator."""
