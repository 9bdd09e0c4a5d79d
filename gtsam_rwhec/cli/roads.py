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


def refuse_others(context: typer.Context, taken: Collection[Record], needs: Mapping[Record, str]) -> None:
    """Refuse each option that the user gave and that none of the taken records has.

    Parameters
    ----------
    context
        Of the subcommand, with what was given.
    taken
        The records that the chosen way takes.
    needs
        For each record of the subcommand, what must be there for its options to count, and what to do if it is not.

    Raises
    ------
    typer.BadParameter
        Names the options, says why they do not count, and what to do.
    """
    used = frozenset[str]().union(*map(names, taken))
    reasons = []
    for record, words in needs.items():
        passed_over = names(record) - used
        used |= passed_over  # an option that two records have is named once
        options = [
            max(parameter.opts, key=len)
            for parameter in context.command.params
            if parameter.name in passed_over and is_given(context, parameter.name)
        ]
        if options:
            reasons.append(f"{', '.join(options)}: {words}")
    if reasons:
        raise typer.BadParameter("\n".join(reasons))


def is_given(context: typer.Context, name: str) -> bool:
    """Whether the user wrote this option, be it with its default value."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
