"""Refusal of options that have no effect on the given input."""

from __future__ import annotations

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
