"""Where the repository's own files are, for tests at any depth."""

from __future__ import annotations

from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY / "data"
CELL = DATA / "cell"
DEMO = DATA / "demo"
EXAMPLES = REPOSITORY / "examples"
GOLDEN = REPOSITORY / "tests" / "golden"
