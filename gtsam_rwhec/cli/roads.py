"""A subcommand can go several ways. An option that the chosen way would pass over is refused."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import typer


def refuse(context: typer.Context, options: Mapping[str, Collection[str]]) -> None:
    """Refuse each of these options that the user gave, be it with its default value.

    Parameters
    ----------
    context
        Of the subcommand, with what was given.
    options
        For each reason why options do not count on the chosen way (and what to do): the names of their parameters.

    Raises
    ------
    typer.BadParameter
        Names the options, says why they do not count, and what to do.
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
