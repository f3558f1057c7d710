"""Pilot: the network that steers, its file, what it looks at, and the page that shows it."""
