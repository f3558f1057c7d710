"""Tools: benchmarks and the training of the lane network; run one with `python -m tools.NAME`."""
