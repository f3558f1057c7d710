"""Tools: benchmarks, the scoreboard and the training of the lane network; run each as `python -m tools.NAME`."""
