"""The wheel that users install: the demo works from it, far away from any checkout."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def unpacked_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel as pip would unpack it."""
    built = tmp_path_factory.mktemp("built")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(built)], cwd=REPOSITORY, check=True
    )
    (wheel,) = built.glob("*.whl")
    unpacked = tmp_path_factory.mktemp("site-packages")
    zipfile.ZipFile(wheel).extractall(unpacked)
    return unpacked


def test_it_has_all_data_and_none_of_the_real_dataset(unpacked_wheel: Path) -> None:
    shipped = unpacked_wheel / "gtsam_rwhec" / "demo_data"
    for folder, source in ((shipped, "demo"), (shipped / "cell", "cell")):
        files = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
        assert files == {path.name: path.read_bytes() for path in (REPOSITORY / "data" / source).iterdir()}
    assert (unpacked_wheel / "gtsam_rwhec" / "utias_files.txt").is_file()
    assert (unpacked_wheel / "gtsam_rwhec" / "py.typed").is_file()
    assert {path.parent.name for path in unpacked_wheel.rglob("*.csv")} == {"demo_data"}


def test_the_demo_runs_from_it(unpacked_wheel: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gtsam_rwhec.cli", "demo"],
        capture_output=True,
        text=True,
        encoding="utf-8",
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(unpacked_wheel), "PYTHONIOENCODING": "utf-8"},
    )
    assert done.returncode == 0, done.stderr
    assert str(unpacked_wheel / "gtsam_rwhec" / "demo_data") in done.stdout
    assert "Certified globally optimal" in done.stdout
