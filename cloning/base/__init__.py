"""The base: arguments, errors, files and films, for every other package."""
