"""A subcommand can go several ways. An option that the chosen way would pass over is refused.

Each way takes records of options (dataclasses); the names of their fields are the names of the options. So what a way
takes, and what is refused, is said once: by its records.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields
from typing import Any

import typer

Record = type[Any]


def names(record: Record) -> frozenset[str]:
    """Names of a record's fields, which are those of the subcommand's parameters."""
    return frozenset(field.name for field in fields(record))


def refuse_others(context: typer.Context, taken: Collection[Record], others: Mapping[Record, str]) -> None:
    """Refuse each option that the user gave and that none of the taken records has.

    Parameters
    ----------
    context
        Of the subcommand, with what was given.
    taken
        The records that the chosen way takes.
    others
        The other records of the subcommand: why their options do not count on this way, and what to do.

    Raises
    ------
    typer.BadParameter
        Names the options, says why they do not count, and what to do.
    """
    used = frozenset[str]().union(*map(names, taken))
    refused: dict[str, list[str]] = {}
    for record in others:
        for parameter in context.command.params:
            if parameter.name in names(record) - used and is_given(context, parameter.name):
                refused.setdefault(others[record], []).append(max(parameter.opts, key=len))
    if refused:
        raise typer.BadParameter("\n".join(f"{', '.join(options)}: {why}" for why, options in refused.items()))


def is_given(context: typer.Context, name: str) -> bool:
    """Whether the user wrote this option, be it with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
