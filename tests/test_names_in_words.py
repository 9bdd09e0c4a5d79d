"""Every dotted name that the pages, the examples and the package's own words use is there."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import pkgutil
import re
import typing
from collections.abc import Iterator
from pathlib import Path

import gtsam
import pytest
import rwhec_factors
from places import REPOSITORY

import gtsam_rwhec
from gtsam_rwhec.logs.mcap_writer import json_schema

PAGES = [
    path
    for pattern in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "docs/*.md", "factors/README.md")
    for path in sorted(REPOSITORY.glob(pattern))
]
SOURCES = [
    path for folder in ("gtsam_rwhec", "factors", "examples") for path in sorted((REPOSITORY / folder).rglob("*.py"))
]
# What the pages call objects of these classes.
OBJECTS = {
    "problem": gtsam_rwhec.Problem,
    "solution": gtsam_rwhec.Solution,
    "certificate": gtsam_rwhec.Certificate,
    "identifiability": gtsam_rwhec.Identifiability,
    "refined": gtsam_rwhec.Refined,
    "log": gtsam_rwhec.logs.Log,
    "graph": gtsam.NonlinearFactorGraph,
}
OF_PACKAGES = re.compile(r"(?<![\w./\"-])(gtsam_rwhec|rwhec_factors|rw)((?:\.[A-Za-z_]\w*)+)")
IN_BACKTICKS = re.compile(r"`([A-Za-z_]\w*)((?:\.[A-Za-z_]\w*)+)(?:\([^`]*)?`")
FILE_ENDINGS = {"html", "py", "md", "json", "jsonl", "parquet", "yaml", "toml", "mcap", "xacro", "png", "csv", "txt"}


def owners() -> dict[str, list[object]]:
    """What a first name may mean: modules by their last name, classes, and objects named for a class ("request")."""
    found: dict[str, list[object]] = {}
    for package in (gtsam_rwhec, rwhec_factors):
        for about in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if about.name.endswith("__main__"):
                continue
            module = importlib.import_module(about.name)
            found.setdefault(about.name.rpartition(".")[2], []).append(module)
            for name, kind in inspect.getmembers(module, inspect.isclass):
                if kind.__module__ == module.__name__:
                    found.setdefault(name, []).append(kind)
                    found.setdefault(name.lower(), []).append(kind)
    for name, kind in OBJECTS.items():
        found[name] = [kind]
    return found


OWNERS = owners()


def dotted(match: re.Match[str]) -> tuple[str, list[str]]:
    """The first name, and those after it."""
    return match[1], match[2].strip(".").split(".")


def reached(owner: object, names: list[str]) -> bool:
    """Whether each name is there: in a module or class, or as a field of a class, whose type is then followed."""
    for name in names:
        if inspect.isclass(owner):
            hints = typing.get_type_hints(owner) if dataclasses.is_dataclass(owner) else {}
            member = inspect.getattr_static(owner, name, None)
            if isinstance(member, property):
                hints = {name: typing.get_type_hints(member.fget).get("return")}
            elif name not in hints and member is None and f"self.{name}" not in inspect.getsource(owner):
                return False
            owner = hints.get(name)
            if not inspect.isclass(owner):
                return True  # a method, or a type that says no more
        elif hasattr(owner, name):
            owner = getattr(owner, name)
        else:
            try:
                owner = importlib.import_module(f"{getattr(owner, '__name__', '')}.{name}")
            except ImportError:
                return False
    return True


def is_schema(name: str) -> bool:
    """Whether this is the name of a message in logs."""
    try:
        json_schema(name)
    except KeyError:
        return False
    return True


def missing(text: str) -> Iterator[str]:
    """Names in a text that are not there."""
    for match in OF_PACKAGES.finditer(text):
        first, names = dotted(match)
        if names[-1] in FILE_ENDINGS or is_schema(match[0]):
            continue
        package = gtsam_rwhec if first == "rw" else importlib.import_module(first)
        in_table = first != "rw" or names[0] in (*gtsam_rwhec.__all__, "__version__")  # rw.x needs no other import
        if not in_table or not reached(package, names):
            yield match[0]
    for match in IN_BACKTICKS.finditer(text):
        first, names = dotted(match)
        owners = OWNERS.get(first, [])
        if owners and names[-1] not in FILE_ENDINGS and not any(reached(owner, names) for owner in owners):
            yield match[0]


@pytest.mark.parametrize("path", PAGES + SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_every_dotted_name_is_there(path: Path) -> None:
    assert list(missing(path.read_text(encoding="utf-8"))) == []


def test_names_that_are_not_there_are_found() -> None:
    text = "`rw.guess`, gtsam_rwhec.solver.guess, `problem.guess(...)`, `solution.certificate.guess`, `Log.guess`"
    assert len(list(missing(text))) == 5
    text = "`rw.refine`, gtsam_rwhec.solver.search, `problem.add(...)`, `solution.certificate.cause`, `Log.records`"
    assert list(missing(text)) == []
