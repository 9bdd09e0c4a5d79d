"""Fixtures that several tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def utias_folder() -> Path:
    """The RWHEC paper's real dataset, which this repository does not contain."""
    folder = Path(os.environ.get("GTSAM_RWHEC_UTIAS", REPOSITORY.parent / "shared" / "data" / "utias"))
    if not folder.is_dir():
        pytest.fail(f"{folder} does not exist: run `gtsam-rwhec fetch utias DEST` and set GTSAM_RWHEC_UTIAS=DEST")
    return folder
