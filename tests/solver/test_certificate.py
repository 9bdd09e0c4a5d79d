"""What a certificate says of its own numbers, and of parts together."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import pytest

from gtsam_rwhec.solver.cause import Cause, Multipliers, SearchPath, Start, Status
from gtsam_rwhec.solver.certificate import Certificate, Objective

CERTIFIED = Certificate(
    status=Status.CERTIFIED,
    cause=Cause.PROVEN,
    objective=Objective("direct", has_priors=False),
    path=SearchPath(Start.SPECTRAL, Multipliers.KKT),
    cost=100.0,
    lower_bound=100.0 - 1e-6,
    float_bound=100.0 - 1e-12,
    min_eigenvalue=-1e-6,
    tolerance=1e-4,
    is_relative=False,
    seconds={"descent": 1.0},
)


def test_gaps() -> None:
    assert CERTIFIED.gap == pytest.approx(1e-6)
    assert CERTIFIED.relative_gap == pytest.approx(1e-8)
    assert CERTIFIED.float_gap == pytest.approx(1e-14, rel=1e-1)


def test_a_bound_above_the_cost_by_rounding_is_no_negative_gap() -> None:
    above = replace(CERTIFIED, lower_bound=100.0 + 1e-13, float_bound=100.0 + 1e-13)
    assert above.gap == above.relative_gap == above.float_gap == 0.0


@pytest.mark.parametrize("cost", [0.0, 1e-20, -1e-12])
def test_a_cost_of_zero_has_a_finite_relative_gap(cost: float) -> None:
    """Data without noise: 0 / 0 counts on the scale of the tolerance, which is a millionth of a cost that counts."""
    exact = replace(CERTIFIED, cost=cost, lower_bound=-1e-10, float_bound=-1e-14, tolerance=1e-6)
    assert 0.0 <= exact.float_gap <= exact.relative_gap
    assert exact.relative_gap == pytest.approx(1e-10, rel=0.05)


@pytest.mark.parametrize(
    ("status", "is_certified", "is_optimal"),
    [
        (Status.CERTIFIED, True, True),
        (Status.CERTIFIED_NOT_UNIQUE, False, True),
        (Status.GAP, False, False),
        (Status.FAILED, False, False),
    ],
)
def test_statuses(status: Status, is_certified: bool, is_optimal: bool) -> None:
    certificate = replace(CERTIFIED, status=status)
    assert certificate.is_certified == is_certified
    assert certificate.is_optimal == is_optimal
    assert str(certificate).startswith(f"{status.value}: cost 100")


def test_status_is_its_word() -> None:
    assert [str(status) for status in Status] == ["certified", "certified_not_unique", "gap", "failed"]
    assert Status("gap") is Status.GAP


def test_unit_weights_are_said() -> None:
    assert "unit weights" not in str(CERTIFIED)
    assert "(unit weights: relative)" in str(replace(CERTIFIED, is_relative=True))


def test_nothing_can_be_changed_afterwards() -> None:
    with pytest.raises(FrozenInstanceError):
        CERTIFIED.cost = 0.0  # type: ignore[misc]


class TestMerged:
    def test_one_is_itself(self) -> None:
        assert Certificate.merged([CERTIFIED]) is CERTIFIED

    @pytest.mark.parametrize(
        ("worst", "cause"),
        [
            (Status.CERTIFIED, Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS),
            (Status.CERTIFIED_NOT_UNIQUE, Cause.TWIN),
            (Status.GAP, Cause.NOT_TIGHT),
            (Status.FAILED, Cause.NO_BOUND),
        ],
    )
    def test_costs_and_bounds_add_and_the_worst_cause_counts(self, worst: Status, cause: Cause) -> None:
        other = replace(
            CERTIFIED,
            status=worst,
            cause=cause,
            figures={"relaxation_cost": 40.0} if cause is Cause.NOT_TIGHT else {},
            path=SearchPath(Start.CLARABEL, Multipliers.ALL_CONSTRAINTS),
            cost=50.0,
            lower_bound=40.0,
            float_bound=45.0,
            min_eigenvalue=-3.0,
            seconds={"descent": 0.5, "small dual": 2.0},
        )
        for order in ([CERTIFIED, other], [other, CERTIFIED]):
            both = Certificate.merged(order)
            assert both.status is worst
            assert both.cost == 150.0
            assert both.lower_bound == pytest.approx(140.0 - 1e-6)
            assert both.float_bound == pytest.approx(145.0)
            assert both.min_eigenvalue == -3.0
            assert both.tolerance == pytest.approx(2e-4)
            assert both.seconds == {"descent": 1.5, "small dual": 2.0}
            assert (both.cause, both.path) == (other.cause, other.path)
            assert both.reason == f"2 unconnected parts, solved separately; {other.reason}"
