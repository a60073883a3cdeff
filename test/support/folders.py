"""Folders of the project that tests and bench read."""

from pathlib import Path as FilePath

ROOT = FilePath(__file__).parents[2]
CONFIG = ROOT / "config"
DATA = ROOT / "test" / "data"
CASES = DATA / "cases"
