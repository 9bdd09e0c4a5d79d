"""Each set of packages that an installation may have, alone in an environment: what works, and what names its extra.

tests/factors/test_drop_in.py has the factors with gtsam and numpy alone, tests/cli/test_wheel.py the wheel with all.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sysconfig
import tomllib
import venv
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from places import CELL, DEMO, REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def distributions_of(requirements: list[str]) -> set[str]:
    """The names of the installed distributions that requirements need, with all that these need."""
    found: set[str] = set()
    open_ones = list(requirements)
    while open_ones:
        requirement = open_ones.pop()
        name = re.match(r"[\w.-]+", requirement)
        assert name is not None
        if name[0] == "gtsam-rwhec":
            extras = re.search(r"\[(.*)\]", requirement)
            assert extras is not None
            for extra in extras[1].split(","):
                open_ones += PROJECT["optional-dependencies"][extra]
        elif name[0] not in found and name[0] != "rwhec-factors" and "extra ==" not in requirement:
            try:
                needs = distribution(name[0]).requires or []
            except PackageNotFoundError:
                assert ";" in requirement, requirement  # for another platform or Python
                continue
            found.add(name[0])
            open_ones += needs
    return found


def environment_of(folder: Path, requirements: list[str]) -> Path:
    """The Python of a fresh environment that has this checkout, and of the installed packages what is required."""
    venv.create(folder, with_pip=False, symlinks=True)
    of_folder = {"base": str(folder), "platbase": str(folder)}
    site = Path(sysconfig.get_path("purelib", "venv", vars=of_folder))
    for name in [*distributions_of(requirements), "gtsam-rwhec"]:
        for file in distribution(name).files or []:
            top = Path(file).parts[0]
            ours = name == "gtsam-rwhec" and not top.endswith(".dist-info")  # copied from this checkout below
            if not ours and top not in ("..", "__pycache__") and not (site / top).exists():
                (site / top).symlink_to(Path(str(distribution(name).locate_file(top))))
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(REPOSITORY / "gtsam_rwhec", site / "gtsam_rwhec", ignore=ignored)
    shutil.copytree(CELL, site / "gtsam_rwhec" / "demo_data")
    shutil.copytree(REPOSITORY / "factors" / "rwhec_factors", site / "rwhec_factors", ignore=ignored)
    return Path(sysconfig.get_path("scripts", "venv", vars=of_folder)) / "python"


def said_by(python: Path, code: str, *arguments: str) -> tuple[str, str]:
    """Standard output and error of code in an environment."""
    command = [str(python), "-I", "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=python.parents[1])
    return done.stdout, done.stderr


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return environment_of(tmp_path_factory.mktemp("core") / "environment", PROJECT["dependencies"])


POSES = """
import sys
import gtsam_rwhec as rw
problem = rw.read_csv(sys.argv[1], scale="shared")
assert rw.certify(problem, (s := rw.solve(problem)).X, s.Y, s.scale).is_certified
assert rw.refine(problem, s).graph.size() > 0
rw.write_calibration(rw.calibrate(problem), "calibration.json")
print(rw.results.read_result("calibration.json").judgement.verdict.name)
"""


def test_poses_are_calibrated_with_what_is_required_alone(core: Path) -> None:
    said, errors = said_by(core, POSES, str(DEMO))
    assert said.split() == ["USE"], errors


@pytest.mark.parametrize(
    ("code", "extra"),
    [
        ("rw.logs.open_log('run.mcap')", "log"),
        ("rw.rig.read_rig('rig.yaml')", "log"),
        ("rw.report.write_html", "report"),
        ("import gtsam_rwhec.cli; gtsam_rwhec.cli.main()", "cli"),
    ],
)
def test_what_lacks_an_extra_names_it(core: Path, code: str, extra: str) -> None:
    _, errors = said_by(core, f"import gtsam_rwhec as rw\n{code}")
    assert f"pip install 'gtsam-rwhec[{extra}]'" in errors.splitlines()[-1]
    assert "During handling" not in errors


def test_logs_are_read_with_their_extra_alone(tmp_path: Path) -> None:
    requirements = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["log"]]
    python = environment_of(tmp_path / "environment", requirements)
    code = "import gtsam_rwhec as rw, sys; print(len(rw.logs.open_log(sys.argv[1]).topics()))"
    said, errors = said_by(python, code, str(CELL / "robot_cell.mcap"))
    assert int(said) > 0, errors


def test_the_command_solves_with_its_extra_alone(tmp_path: Path) -> None:
    requirements = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["cli"]]
    python = environment_of(tmp_path / "environment", requirements)
    code = "import sys; from gtsam_rwhec.cli import main; sys.argv[0] = 'gtsam-rwhec'; main()"
    said, errors = said_by(python, code, "calibrate", str(DEMO), "-o", "calibration.json")
    assert said.startswith("Use these poses"), errors
    said, errors = said_by(python, code, "calibrate", str(CELL / "robot_cell.mcap"), "--rig", str(CELL / "rig.yaml"))
    assert "pip install 'gtsam-rwhec[log]'" in errors


def test_the_extra_of_the_readme_has_what_clouds_need() -> None:
    (everyone,) = (name for name in PROJECT["optional-dependencies"]["all"] if name.startswith("gtsam-rwhec["))
    assert "clouds" in everyone
