"""The engine on Dask: order, failures, workers that die."""

from __future__ import annotations

import pytest

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fleet.extras import imported


def test_what_is_not_installed_is_named_with_its_command() -> None:
    with pytest.raises(
        OptionError, match=r"robots: no_such_module is not installed: pip install 'gtsam-rwhec\[fleet\]'"
    ):
        imported("no_such_module.part", "fleet", "robots")
    assert imported("os.path", "fleet", "robots").sep == "/"
