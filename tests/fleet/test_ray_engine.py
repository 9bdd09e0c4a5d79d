"""The engine on Ray: the same order, failures and deaths as on Dask."""

from __future__ import annotations

from pathlib import Path

import pytest
from engine_checks import check_deaths, check_order_and_failures

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.fleet.ray_engine import RayEngine

MEMORY = 400 << 20


def test_what_cannot_be_an_engine() -> None:
    with pytest.raises(OptionError, match="0 workers cannot work"):
        RayEngine(0)


@pytest.mark.slow
def test_failures_and_deaths(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="it is the extra `ray`")
    for name in ("order", "deaths"):
        (tmp_path / name).mkdir()
    with RayEngine(2, MEMORY, pause_s=0.001) as engine:
        check_order_and_failures(engine, tmp_path / "order", attempts=3)
        check_deaths(engine, tmp_path / "deaths", MEMORY, attempts=3)
