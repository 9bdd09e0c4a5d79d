"""Reference of the command, made from the functions that it calls and their annotations: ``made/commands.md``."""

from __future__ import annotations

import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

import typer
from sphinx.application import Sphinx

from building.links import DOCS
from building.repository_pages import write_if_other
from gtsam_rwhec.cli.app import app as command

_INTRODUCTION = """# Reference of the command

This page is made from the command: `gtsam-rwhec COMMAND --help` says the same.
"""
_VALUES = {"Path": "path", "str": "text", "int": "whole number", "float": "number"}


def _plain(words: str | None) -> str:
    """Words of a help text for a cell of a table, or a paragraph."""
    return re.sub(r"([|<\[*_])", r"\\\1", re.sub(r"\s+", " ", words or "").strip())


def _paragraphs(words: str | None) -> str:
    return "\n\n".join(_plain(part) for part in re.split(r"\n\s*\n|\f", inspect.cleandoc(words or "")) if part.strip())


def _value(kind: Any) -> str:
    """What an option takes, in words."""
    if typing.get_origin(kind) is typing.Literal:
        return ", ".join(f"`{each}`" for each in typing.get_args(kind))
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return ", ".join(_value(each) for each in typing.get_args(kind) if each is not type(None))
    if typing.get_origin(kind) in (list, tuple):
        return f"{_value(typing.get_args(kind)[0])}, may be repeated"
    return "" if kind is bool else _VALUES.get(kind.__name__, kind.__name__)


def _names(parameter: inspect.Parameter, about: Any) -> str:
    if isinstance(about, typer.models.ArgumentInfo):
        return f"`{(about.metavar or parameter.name).upper()}`"
    given = [each for each in about.param_decls or () if each.startswith("-")]
    return ", ".join(f"`{each}`" for each in given or [f"--{parameter.name.replace('_', '-')}"])


def _without(parameter: inspect.Parameter) -> str:
    default = parameter.default
    if default is parameter.empty or default is ...:
        return "must be given"
    return "" if default in (None, False, (), []) or default == [] else f"`{default}`"


def _tables(function: Callable[..., Any]) -> Iterator[str]:
    """A table for each group of arguments and options."""
    groups: dict[str, list[str]] = {}
    usage = []
    for parameter in inspect.signature(function, eval_str=True).parameters.values():
        if parameter.annotation is typer.Context:  # what Typer hands over, not the user
            continue
        kind, about = typing.get_args(parameter.annotation)[:2]
        if about.hidden:
            continue
        is_argument = isinstance(about, typer.models.ArgumentInfo)
        if is_argument:
            word = (about.metavar or parameter.name).upper()
            usage.append(word if parameter.default is parameter.empty else f"[{word}]")
        title = about.rich_help_panel or ("Arguments" if is_argument else "Options")
        row = f"| {_names(parameter, about)} | {_plain(about.help)} | {_value(kind)} | {_without(parameter)} |"
        groups.setdefault(title, []).append(row)
    yield " ".join(["[OPTIONS]", *usage])
    for title, rows in groups.items():
        yield f"**{title}**\n"
        yield "| name | is | value | without it |\n| --- | --- | --- | --- |"
        yield from (*rows, "")


def _command(name: str, function: Callable[..., Any]) -> Iterator[str]:
    usage, *tables = _tables(function)
    yield f"## {name}\n\n```text\n{name} {usage}\n```\n\n{_paragraphs(function.__doc__)}\n"
    yield from tables


def _commands(name: str, found: typer.Typer) -> Iterator[str]:
    """The commands of a group and of those below it, in their order."""
    for each in found.registered_commands:
        assert each.callback is not None
        yield from _command(f"{name} {each.name or each.callback.__name__}", each.callback)
    for group in found.registered_groups:
        assert group.typer_instance is not None
        yield from _commands(f"{name} {group.name}", group.typer_instance)


def page() -> str:
    """The page, in Markdown."""
    top = [_INTRODUCTION, f"{_paragraphs(command.info.help)}\n", f"{_paragraphs(command.info.epilog)}\n"]
    return "\n".join([*top, *_commands("gtsam-rwhec", command)])


def _write_page(*_: object) -> None:
    write_if_other(DOCS / "made" / "commands.md", page())


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect to Sphinx."""
    app.connect("config-inited", _write_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
