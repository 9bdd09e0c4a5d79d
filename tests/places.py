"""Where the repository's own files are, for tests at any depth."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY / "data"
CELL = DATA / "cell"
DEMO = DATA / "demo"
EXAMPLES = REPOSITORY / "examples"
GOLDEN = REPOSITORY / "tests" / "golden"


def script(path: Path) -> ModuleType:
    """A script of the repository that no package has, as a module."""
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification is not None
    assert specification.loader is not None
    sys.modules[path.stem] = module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module
