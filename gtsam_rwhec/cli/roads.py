"""Refusal of options that have no effect on the given input."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Mapping

import typer


def refuse(context: typer.Context, options: Mapping[str, Collection[str]]) -> None:
    """Refuse those of these options that the user wrote, even with the default value.

    `options` has names of parameters without effect, by the reason and what to do. Raises `typer.BadParameter` if the
    user wrote some of them; its message has the options and the reasons.
    """
    lines = []
    for why, names in options.items():
        refused = [
            max(parameter.opts, key=len)
            for parameter in context.command.params
            if parameter.name in names and is_given(context, parameter.name)
        ]
        if refused:
            lines.append(f"{', '.join(refused)}: {why}")
    if lines:
        raise typer.BadParameter("\n".join(lines))


def is_given(context: typer.Context, name: str) -> bool:
    """Whether the user wrote this option."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def command_of(context: typer.Context) -> str:
    """The command as it was given: its arguments, and the options that are not left to their defaults."""
    words = ["gtsam-rwhec", context.info_name or ""]
    for parameter in context.command.params:
        name, value = str(parameter.name), context.params.get(str(parameter.name))
        if parameter.param_type_name == "argument":
            words.append(str(value))
        elif is_given(context, name):
            words += [parameter.opts[0]] if value is True else [parameter.opts[0], str(value)]
    return shlex.join(words)
