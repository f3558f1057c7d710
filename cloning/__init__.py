"""Learning to drive from recordings: everything but the commands and the stand-in simulator."""
