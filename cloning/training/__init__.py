"""Training: what model.py needs besides the report's own steps, from options and checkpoints to --robust."""
