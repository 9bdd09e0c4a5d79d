"""Reference of the names in Python, made from the packages' tables of contents (``__init__.pyi``) and the docstrings.

Each package has a page, ``made/api/NAME.rst``, in the order and under the headings of its table. A name that several
tables have is described once, where its name is shortest; the others lead there.
"""

from __future__ import annotations

import ast
import enum
import importlib
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import rwhec_factors
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

import gtsam_rwhec
from building.links import DOCS
from building.repository_pages import write_if_other

PAGES = DOCS / "made" / "api"


@dataclass(frozen=True)
class Entry:
    """A public name of a package."""

    #: As a program writes it, with its package.
    name: str
    #: The module that defines it.
    module: str
    #: The heading of the table that it stands under, or "".
    heading: str
    object: Any

    @property
    def identity(self) -> tuple[str, str]:
        """What it is, whatever the package that names it."""
        return self.module, self.name.rpartition(".")[2]


def table_of(package: ModuleType) -> list[Entry]:
    """The public names of a package, in the order of its table of contents."""
    assert package.__file__ is not None
    table = Path(package.__file__ + "i")
    if not table.is_file():  # a package whose names are imported at once
        names = getattr(package, "__all__", [])
        return [_entry(package, name, getattr(package, name).__module__, "") for name in names]
    text = table.read_text(encoding="utf-8")
    lines = text.splitlines()
    entries, heading = [], ""
    end = 0
    for node in ast.parse(text).body:
        for line in lines[end : node.lineno - 1]:
            heading = line.lstrip("# ").rstrip(".") if line.startswith("#") else heading
        end = node.end_lineno or node.lineno
        if isinstance(node, ast.ImportFrom):
            module = f"{package.__name__}.{node.module}" if node.module else package.__name__
            entries += [_entry(package, alias.name, module, heading) for alias in node.names]
    return entries


def _entry(package: ModuleType, name: str, module: str, heading: str) -> Entry:
    found = getattr(package, name)
    if not isinstance(found, ModuleType):
        module = getattr(found, "__module__", module) if not _is_plain(found) else module
    return Entry(f"{package.__name__}.{name}", module, heading, found)


def _is_plain(found: object) -> bool:
    """Whether this is a value (a table, a type's other name), which autodoc has no docstring of."""
    return not (inspect.isclass(found) or inspect.isroutine(found) or isinstance(found, ModuleType))


def packages() -> Iterator[ModuleType]:
    """The packages that have public names, the most general one first."""
    yield gtsam_rwhec
    root = Path(str(gtsam_rwhec.__file__)).parent
    for table in sorted(root.rglob("__init__.pyi")):
        if table.parent != root:
            yield importlib.import_module(".".join(("gtsam_rwhec", *table.parent.relative_to(root).parts)))
    yield gtsam_rwhec.errors
    yield rwhec_factors


def module_names(module: ModuleType) -> list[Entry]:
    """The public classes and functions of a module without a table, in their order."""
    found = [
        Entry(f"{module.__name__}.{name}", module.__name__, "", value)
        for name, value in vars(module).items()
        if not name.startswith("_") and getattr(value, "__module__", "") == module.__name__
    ]
    return sorted(found, key=lambda entry: inspect.getsourcelines(entry.object)[1])


def _description(entry: Entry) -> list[str]:
    """The directive that describes a name."""
    found = entry.object
    if inspect.isclass(found):
        kind = "autoexception" if issubclass(found, BaseException) else "autoclass"
        lines = [f".. {kind}:: {entry.name}", "   :members:"]
        if issubclass(found, enum.Enum):
            lines.append("   :undoc-members:")
        others = [base for base in found.__mro__[1:] if base.__module__.startswith("gtsam_rwhec")]
        if others and found.__mro__[-2].__module__.startswith("gtsam_rwhec"):
            lines.append("   :inherited-members:")
        return [*lines, ""]
    if inspect.isroutine(found):
        return [f".. autofunction:: {entry.name}", ""]
    comment = ModuleAnalyzer.for_module(entry.module).find_attr_docs().get(("", entry.name.rpartition(".")[2]), [])
    return [f".. py:data:: {entry.name}", "", *(f"   {line}" for line in comment), ""]


def _first_sentence(module: ModuleType) -> str:
    return (inspect.getdoc(module) or "").split("\n\n")[0].replace("\n", " ")


def _title(words: str, line: str) -> list[str]:
    return [words, line * len(words), ""]


def _short(name: str) -> str:
    """A package's name as programs write it: with rw where `import gtsam_rwhec as rw` is enough."""
    first, *rest = name.split(".")
    reached = first == "gtsam_rwhec" and (not rest or rest[0] in gtsam_rwhec.__all__)
    return ".".join(["rw", *rest]) if reached else name


def page_of(package: ModuleType, entries: list[Entry], described: dict[tuple[str, str], str], pages: set[str]) -> str:
    """A package's page, in reStructuredText.

    Parameters
    ----------
    package
        The package, or a module with public names.
    entries
        Its names.
    described
        Where each name is described that a page before this one had; this page's are added.
    pages
        The names of the packages that have a page.
    """
    lines = [".. This page is made: see docs/building/api_pages.py", "", *_title(_short(package.__name__), "=")]
    lines.append(f".. py:module:: {package.__name__}")
    lines += ["", inspect.getdoc(package) or "", ""]
    heading = ""
    for entry in entries:
        if entry.heading != heading:
            heading = entry.heading
            lines += _title(heading, "-")
        if isinstance(entry.object, ModuleType):
            link = f":doc:`{entry.name}`" if entry.name in pages else f"``{entry.name}``"
            lines += [f"- {link}: {_first_sentence(entry.object)}", ""]
        elif entry.identity in described:
            lines += [f"- :py:obj:`{described[entry.identity]}`", ""]
        else:
            described[entry.identity] = entry.name
            lines += _description(entry)
    return "\n".join(lines)


#: By module and name where it is defined: the public name that the reference describes it under.
DESCRIBED: dict[tuple[str, str], str] = {}


def _write_pages(*_: object) -> None:
    tables = {package.__name__: (package, table_of(package)) for package in packages()}
    for _package, entries in list(tables.values()):  # modules that are named in a table, and have no table of their own
        for entry in entries:
            if isinstance(entry.object, ModuleType) and entry.object.__name__ not in tables:
                tables[entry.object.__name__] = (entry.object, module_names(entry.object))
    tables["gtsam_rwhec.errors"] = (gtsam_rwhec.errors, module_names(gtsam_rwhec.errors))
    names = sorted(
        (name for name, (_package, entries) in tables.items() if entries),
        key=lambda name: (not _short(name).startswith("rw"), name),
    )
    DESCRIBED.clear()
    for name in names:
        package, entries = tables[name]
        write_if_other(PAGES / f"{name}.rst", page_of(package, entries, DESCRIBED, set(names)))
    for old in PAGES.glob("*.rst"):
        if old.stem not in (*names, "index"):
            old.unlink()
    index = [
        *_title("Reference of the names in Python", "="),
        "``import gtsam_rwhec as rw`` reaches all of these names.",
        "",
    ]
    index += [".. toctree::", "   :maxdepth: 1", "", *(f"   {name}" for name in names), ""]
    write_if_other(PAGES / "index.rst", "\n".join(index))


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to Sphinx."""
    app.connect("config-inited", _write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
