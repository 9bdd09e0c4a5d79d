"""The factors alone, in a project that has gtsam and numpy only."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sysconfig
import venv
from pathlib import Path

import gtsam
import numpy as np
import pytest
from places import REPOSITORY

#: Runs the example, then says which top-level modules were imported from outside the standard library.
RUN = """
import json, runpy, sys
from pathlib import Path
example, folder = sys.argv[1:]
sys.argv = [example, "--save", folder]
runpy.run_path(example, run_name="__main__")
site = [Path(p) for p in sys.path if p.endswith("site-packages")]
files = [Path(m.__file__) for m in list(sys.modules.values()) if getattr(m, "__file__", None)]
print(json.dumps(sorted({f.relative_to(s).parts[0] for f in files for s in site if f.is_relative_to(s)})))
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a fresh environment: gtsam and numpy linked, the factors' folder and the example copied."""
    folder = tmp_path_factory.mktemp("drop_in") / "environment"
    venv.create(folder, with_pip=False, symlinks=True)
    site = Path(sysconfig.get_path("purelib", "venv", vars={"base": str(folder), "platbase": str(folder)}))
    for package in (gtsam, np):
        installed = Path(package.__file__).parent
        for part in (installed, installed.with_name(f"{installed.name}.libs")):  # shared libraries beside a wheel's
            if part.is_dir():
                (site / part.name).symlink_to(part)
    shutil.copytree(
        REPOSITORY / "factors" / "rwhec_factors", site / "rwhec_factors", ignore=shutil.ignore_patterns("__pycache__")
    )
    shutil.copy(REPOSITORY / "examples" / "slam_graph.py", folder)
    scripts = sysconfig.get_path("scripts", "venv", vars={"base": str(folder), "platbase": str(folder)})
    return Path(scripts) / "python"


def test_the_slam_graph_is_solved_with_gtsam_and_numpy_alone(environment: Path, tmp_path: Path) -> None:
    example = environment.parents[1] / "slam_graph.py"
    command = [str(environment), "-I", "-c", RUN, str(example), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    *report, imported = done.stdout.splitlines()
    assert json.loads(imported) == ["gtsam", "numpy", "rwhec_factors"]
    assert "No picture: matplotlib is not installed." in report
    text = "\n".join(report)
    millimetres = re.search(r"Batch and iSAM2 agree to (\S+) mm and (\S+) degrees over all 82 variables", text)
    assert millimetres is not None, text
    assert float(millimetres[1]) < 1e-3
    assert float(millimetres[2]) < 1e-4
    distances = [float(d) for d in re.findall(r"squared Mahalanobis distance (\S+),", text)]
    assert len(distances) == 2
    assert max(distances) < 22.5  # 99.9% of a chi-square with six degrees of freedom


def test_nothing_else_can_be_imported_there(environment: Path) -> None:
    for module in ("gtsam_rwhec", "scipy", "matplotlib", "rich"):
        done = subprocess.run([str(environment), "-I", "-c", f"import {module}"], capture_output=True, text=True)
        assert f"No module named '{module}'" in done.stderr
