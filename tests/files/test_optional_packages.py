"""A package that is missing: the error names the extra that installs it."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from gtsam_rwhec.errors import MissingPackageError, RwhecError
from gtsam_rwhec.files.optional_packages import EXTRAS, extra_named


def test_missing_package_of_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    words = r"jinja2 is not installed: pip install 'gtsam-rwhec\[report\]'"
    with pytest.raises(MissingPackageError, match=words) as e, extra_named():
        import jinja2  # noqa: F401
    assert isinstance(e.value, RwhecError)
    assert isinstance(e.value, ImportError)
    assert e.value.name == "jinja2"


def test_other_missing_modules_are_left_alone() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_module") as e, extra_named():
        import no_such_module  # noqa: F401
    assert not isinstance(e.value, RwhecError)


@pytest.mark.parametrize(
    ("package", "statement", "extra"), [("cv2", "rw.detect.decode_gray", "log"), ("mcap", "rw.calibrate_log", "log")]
)
def test_names_of_packages(package: str, statement: str, extra: str) -> None:
    code = f"""
import sys
sys.modules[{package!r}] = None
import gtsam_rwhec as rw
try:
    {statement}
except rw.errors.MissingPackageError as error:
    print(error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == f"{package} is not installed: pip install 'gtsam-rwhec[{extra}]'\n"


def test_each_package_is_in_the_extra_that_is_named() -> None:
    distributions = {
        "PIL": "pillow", "cv2": "opencv-python-headless", "distributed": "dask", "google": "protobuf",
        "lzf": "python-neo-lzf", "small_gicp": "small-gicp",
        "mcap_protobuf": "mcap-protobuf-support", "yaml": "pyyaml",
    }  # fmt: skip
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")
    extras = tomllib.loads(text)["project"]["optional-dependencies"]
    for package, extra in EXTRAS.items():
        names = {re.match(r"[\w-]+", requirement)[0] for requirement in extras[extra]}  # type: ignore[index]
        assert distributions.get(package, package) in names, package
