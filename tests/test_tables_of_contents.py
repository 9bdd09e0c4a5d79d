"""What a program reaches by name: each package's table of contents, and each module by its own name."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import rwhec_factors

import gtsam_rwhec

MODULES = [
    found
    for package in (gtsam_rwhec, rwhec_factors)
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if not found.name.endswith("__main__")
]
PACKAGES = ["gtsam_rwhec", "rwhec_factors", *(found.name for found in MODULES if found.ispkg)]


@pytest.mark.parametrize("name", PACKAGES)
def test_every_name_of_a_table_is_there(name: str) -> None:
    package = importlib.import_module(name)
    names = getattr(package, "__all__", [])
    assert sorted(set(names)) == sorted(names)
    for entry in names:
        assert getattr(package, entry) is not None
    assert set(names) <= set(dir(package))


@pytest.mark.parametrize("name", PACKAGES)
def test_no_name_of_a_table_hides_a_module(name: str) -> None:
    """`import package.name as x` gives what the package has under that name; that must be the module."""
    package = importlib.import_module(name)
    submodules = {found.name.rpartition(".")[2] for found in pkgutil.iter_modules(package.__path__)}
    hidden = {
        entry
        for entry in submodules & set(getattr(package, "__all__", ()))
        if not isinstance(getattr(package, entry), ModuleType)
    }
    assert not hidden


def test_every_module_is_imported_by_its_name() -> None:
    for found in MODULES:
        names: dict[str, object] = {}
        exec(f"import {found.name} as it", names)
        assert names["it"] is sys.modules[found.name], found.name


def test_no_package_but_the_command_goes_by_the_table_of_all() -> None:
    """It reaches every package, those of higher layers too, and import-linter sees none of that."""
    by_the_top = re.compile(r"^\s*(from gtsam_rwhec import|import gtsam_rwhec(?!\.))", re.MULTILINE)
    root = Path(str(gtsam_rwhec.__file__)).parent
    found = {
        path.relative_to(root).parts[0]
        for path in root.rglob("*.py")
        if by_the_top.search(path.read_text(encoding="utf-8"))
    }
    assert found == {"cli"}


def test_a_table_is_for_type_checkers_what_it_is_for_programs() -> None:
    """mypy and editors read the stubs; a name without `as` would be unknown to them."""
    for name in PACKAGES:
        package = importlib.import_module(name)
        assert package.__file__ is not None
        if not hasattr(package, "__getattr__"):
            continue
        with open(f"{package.__file__}i", encoding="utf-8") as stream:
            stub = ast.parse(stream.read())
        imported = [alias for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names]
        assert all(alias.asname == alias.name for alias in imported), name
        assert sorted(alias.name for alias in imported) == sorted(package.__all__), name


def test_what_the_readme_names_is_reached_without_another_import() -> None:
    code = (
        "import gtsam_rwhec as rw\n"
        "for name in ('report', 'cameras', 'detect', 'logs', 'rig', 'runs', 'methods'):\n"
        "    assert getattr(rw, name).__name__ == f'gtsam_rwhec.{name}' and name in dir(rw)\n"
        "assert rw.calibrate_log is rw.runs.calibrate_log\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="guess"):
        _ = gtsam_rwhec.guess  # type: ignore[attr-defined]
