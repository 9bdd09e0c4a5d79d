"""What certificates say is true of the measurements as given: an oracle of its own attacks problems of every kind.

``campaign.py`` does the same for any number of seeds, and prints what is false by kind.
"""

from __future__ import annotations

import pytest
from campaign import attacked

#: Seeds of one test; the ordinary run has 100 of any kind and 50 sane ones.
RUN = 25


def false_claims(seeds: range, *, sane: bool) -> list[str]:
    return [
        f"seed {seed} ({result.kind}, {result.scale}, {result.status}): {violation}"
        for seed in seeds
        for result in [attacked(seed, sane=sane)]
        for violation in result.violations
    ]


@pytest.mark.parametrize("first", range(0, 100, RUN))
def test_no_claim_is_false(first: int) -> None:
    assert false_claims(range(first, first + RUN), sane=False) == []


@pytest.mark.parametrize("first", range(0, 50, RUN))
def test_no_claim_about_sane_problems_is_false(first: int) -> None:
    assert false_claims(range(first, first + RUN), sane=True) == []


@pytest.mark.campaign
@pytest.mark.parametrize("first", range(10_000, 14_000, 500))
def test_no_claim_of_thousands_is_false(first: int) -> None:
    assert false_claims(range(first, first + 500), sane=False) == []


@pytest.mark.campaign
@pytest.mark.parametrize("first", range(10_000, 12_000, 500))
def test_no_claim_about_thousands_of_sane_problems_is_false(first: int) -> None:
    assert false_claims(range(first, first + 500), sane=True) == []
