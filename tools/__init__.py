"""Tools: benchmarks, the scoreboard and the training of the lane network; run one with `python -m tools.NAME`."""
