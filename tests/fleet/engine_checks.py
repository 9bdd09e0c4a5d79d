"""What holds for every engine."""

from __future__ import annotations

from pathlib import Path

from tasks_of_tests import mixed

from gtsam_rwhec.fleet.tasks import Engine, Failed, Receipt


def check_order_and_failures(engine: Engine, folder: Path) -> None:
    """Each task once, those that come after others after them, and failures as rows."""
    outcomes = list(engine.run(mixed(str(folder))))
    by_key = {each.key: each for each in outcomes}
    keys = [each.key for each in outcomes]
    assert sorted(keys) == ["always", "fault", "high", "low", "refused", "twice", "w0", "w1", "w2", "w3"]
    assert keys.index("low") > max(keys.index("w0"), keys.index("w1"))
    assert keys.index("high") > max(keys.index("low"), keys.index("refused"), keys.index("w3"))
    low, high = by_key["low"], by_key["high"]
    assert isinstance(low, Receipt)
    assert isinstance(high, Receipt)
    assert low.sha256 == "w1.bin + w0.bin"  # in the order of `after`, not of the ends
    assert high.sha256 == "low.bin + no refused: LogError + w3.bin"
    refused, always, fault = (by_key[key] for key in ("refused", "always", "fault"))
    assert isinstance(refused, Failed)
    assert (refused.kind, refused.attempts) == ("LogError", 1)
    assert refused.reason == "refused is not an MCAP file; give another."
    assert isinstance(always, Failed)
    assert (always.kind, always.attempts) == ("TimeoutError", 3)
    assert "is slow" in always.reason
    assert "0123456789abcdef" not in always.reason
    assert "topsecret" not in always.reason
    assert isinstance(fault, Failed)
    assert fault.attempts == 1
    assert "KeyError: 'lost' (tasks_of_tests.py, line" in fault.reason
    tries = {path.stem: path.stat().st_size for path in folder.glob("*.tried")}
    assert tries == {**dict.fromkeys(keys, 1), "twice": 3, "always": 3}
