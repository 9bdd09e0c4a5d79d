"""Tests are found by the name of what they test, or from the table: every module, and nothing that is not there."""

from __future__ import annotations

from where_tested import TESTS, WHERE_TESTED, modules


def test_every_module_has_tests() -> None:
    without = [module for module, own in modules() if not own.is_file() and module not in WHERE_TESTED]
    assert without == [], f"write tests of their names, or enter them in {TESTS / 'where_tested.py'}"


def test_every_entry_is_needed_and_there() -> None:
    own_files = dict(modules())
    gone = [module for module in WHERE_TESTED if module not in own_files]
    assert gone == [], "no such modules"
    needless = [module for module in WHERE_TESTED if own_files[module].is_file()]
    assert needless == [], "they have files of their names"
    missing = sorted({file for file in WHERE_TESTED.values() if not (TESTS / file).is_file()})
    assert missing == [], "no such files"
