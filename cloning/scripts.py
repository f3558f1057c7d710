"""A package of the three scripts: a wheel has them in the folder beside this file, a clone at its top."""

from pathlib import Path

__path__ = [str(Path(__file__).with_suffix("")), str(Path(__file__).parents[1])]
