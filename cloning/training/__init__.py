"""Training: everything that model.py needs besides the steps that the report describes."""
