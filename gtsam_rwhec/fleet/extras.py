"""Libraries that only fleets need: imported when they are used, and named with the command that installs them."""

from __future__ import annotations

import importlib
from types import ModuleType

from gtsam_rwhec.errors import OptionError


def imported(module: str, extra: str, what_for: str) -> ModuleType:
    """A module of an extra.

    Parameters
    ----------
    module
        As ``import`` has it.
    extra
        The extra of this package that brings it.
    what_for
        What needs it, in words: ``"the engine Dask"``.

    Raises
    ------
    OptionError
        It is not installed; the message has the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if (error.name or "").partition(".")[0] != package:  # it is there, and what it needs is not
            package = f"{error.name}, which {package} imports,"
        raise OptionError(f"{what_for}: {package} is not installed: pip install 'gtsam-rwhec[{extra}]'") from error
