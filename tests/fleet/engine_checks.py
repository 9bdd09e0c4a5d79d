"""What holds for every engine."""

from __future__ import annotations

from pathlib import Path

from tasks_of_tests import dies_always, dies_once, floods, joins, mixed, writes

from gtsam_rwhec.fleet.tasks import Engine, Failed, Receipt, Task


def check_deaths(engine: Engine, folder: Path, memory_bytes: int, attempts: int) -> None:
    """A worker that dies is no loss; a task that kills each of its workers, or wants too much memory, is a row."""
    names = {"innocent1": writes, "once": dies_once, "killer": dies_always, "innocent2": writes}
    tasks = [Task(name, function, (str(folder), name)) for name, function in names.items()]
    tasks.append(Task("flood", floods, (str(folder), "flood", 8 * memory_bytes)))
    tasks.append(Task("after", joins, (str(folder), "after"), after=("killer", "once")))
    by_key = {each.key: each for each in engine.run(tasks)}
    assert len(by_key) == len(tasks)
    assert {key for key, each in by_key.items() if isinstance(each, Failed)} == {"killer", "flood"}
    killer, flood, after = by_key["killer"], by_key["flood"], by_key["after"]
    assert isinstance(killer, Failed)
    assert killer.attempts == attempts
    assert f"died, {attempts} times" in killer.reason
    assert isinstance(flood, Failed)
    assert flood.kind == "MemoryError"
    assert isinstance(after, Receipt)
    assert after.sha256 == f"no killer: {killer.kind} + once.bin"
    tries = {path.stem: path.stat().st_size for path in folder.glob("*.tried")}
    assert tries["killer"] == attempts
    # What a worker had done is done again if it dies before the outcome was fetched.
    assert tries["once"] >= 2
    assert tries["flood"] >= 1
    assert set(tries) == {*names, "flood", "after"}


def check_order_and_failures(engine: Engine, folder: Path, attempts: int) -> None:
    """Each task once, those that come after others after them, and failures as rows."""
    outcomes = list(engine.run(mixed(str(folder))))
    by_key = {each.key: each for each in outcomes}
    keys = [each.key for each in outcomes]
    assert sorted(keys) == ["always", "fault", "high", "low", "once", "refused", "w0", "w1", "w2", "w3"]
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
    assert (always.kind, always.attempts) == ("TimeoutError", attempts)
    assert "is slow" in always.reason
    assert "0123456789abcdef" not in always.reason
    assert "topsecret" not in always.reason
    assert isinstance(fault, Failed)
    assert fault.attempts == 1
    assert "KeyError: 'lost' (tasks_of_tests.py, line" in fault.reason
    tries = {path.stem: path.stat().st_size for path in folder.glob("*.tried")}
    assert tries == {**dict.fromkeys(keys, 1), "once": 2, "always": attempts}
