"""Replay: real recordings driven by a model, and scored."""
