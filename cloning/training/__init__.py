"""Training: all that model.py needs besides the report's own steps."""
