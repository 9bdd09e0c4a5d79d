"""Where the RWHEC paper's real dataset is; the repository does not contain it."""

from __future__ import annotations

import os
from pathlib import Path

DEFAULT = Path(__file__).resolve().parents[2] / "shared" / "data" / "utias"


def utias_folder() -> Path:
    """The folder that GTSAM_RWHEC_UTIAS names, or the one beside the checkout."""
    folder = Path(os.environ.get("GTSAM_RWHEC_UTIAS", DEFAULT))
    if not folder.is_dir():
        raise SystemExit(f"{folder} does not exist: run `gtsam-rwhec fetch utias DEST`, set GTSAM_RWHEC_UTIAS=DEST")
    return folder
