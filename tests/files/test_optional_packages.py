"""A package that is missing: the error names the extra that installs it."""

import subprocess
import sys

import pytest

from gtsam_rwhec.errors import MissingPackageError, RwhecError
from gtsam_rwhec.files.optional_packages import extra_named


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
