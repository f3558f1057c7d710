"""The study of whether the loss tells how a network drives."""
