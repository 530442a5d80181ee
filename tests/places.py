"""Folders that tests read."""

from pathlib import Path

TESTS = Path(__file__).resolve().parent
DATA = TESTS / "data"
ROOT = TESTS.parent
DOCS = ROOT / "docs"
SCRIPTS = ROOT / "magtwin" / "export" / "scripts"
