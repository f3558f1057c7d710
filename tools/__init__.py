"""Tools: benchmarks, the score board and the training of the lane network; each runs as `python -m tools.NAME`."""
