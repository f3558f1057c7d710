"""Behavioral cloning: everything that training, driving and replaying need, apart from the three commands."""
