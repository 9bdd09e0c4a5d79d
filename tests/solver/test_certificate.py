"""What a certificate says of its own numbers, and of parts together."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, replace

import pytest

from gtsam_rwhec.solver.certificate import Basis, Cause, Certificate, Multipliers, Objective, SearchPath, Start, Status
from gtsam_rwhec.solver.region import Region

FIGURES = {
    "cost": 2.0,
    "free_directions": 3.0,
    "mirror_cost": 1.0,
    "frames": 130.0,
    "max_dense_frames": 120.0,
    "relaxed": 12.0,
    "relaxation_cost": 1.5,
    "better_cost": 1.0,
}


@pytest.mark.parametrize("cause", list(Cause))
def test_every_cause_has_a_sentence_and_a_status(cause: Cause) -> None:
    said = cause.sentence(FIGURES)
    assert said
    assert not set(said) & set("{}")
    assert cause.status in Status
    assert Cause(str(cause)) is cause


def test_the_three_reasons_of_design_fact_4_are_three_causes() -> None:
    redundant, local, not_tight = (
        Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS,
        Cause.PROVEN_AFTER_LOCAL_MINIMUM,
        Cause.NOT_TIGHT,
    )
    assert [cause.status for cause in (redundant, local, not_tight)] == [Status.CERTIFIED, Status.CERTIFIED, Status.GAP]


def test_a_path_says_how_the_answer_was_found_and_its_bound_proven() -> None:
    path = SearchPath(Start.SPECTRAL, Multipliers.KKT)
    assert path.words == "found from the spectral start, bound proven by the dual multipliers"
    assert str(SearchPath(Start.SPECTRAL, Multipliers.KKT, is_mirrored=True)) == "spectral start, dual, mirrored"


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


def test_a_bound_of_moments_says_so() -> None:
    """The bound of a certificate is of all that was measured, unless it says otherwise beside the bound."""
    measured = replace(CERTIFIED, basis=Basis.MEASUREMENTS)
    assert str(measured) == (
        "certified: cost 100, no answer below 99.999999, relative gap 1.0e-08; proven globally optimal"
    )
    of_moments = str(replace(CERTIFIED, basis=Basis.MOMENTS))
    assert of_moments == str(measured).replace("below 99.999999,", "below 99.999999 (of the moments),")


def test_a_region_is_the_last_of_what_is_said() -> None:
    text = str(replace(CERTIFIED, basis=Basis.MOMENTS, region=Region(353.19, 100.0)))
    assert "(of the moments)" in text
    assert text.endswith(
        "; proven globally optimal; the bound holds for translations within 353 m of the answer's, and for unknown "
        "scales within a factor of 100"
    )


@pytest.mark.parametrize(
    ("radius_m", "factor", "said"),
    [
        (0.0123456, 99.96, "within 0.0123 m of the answer's, and for unknown scales within a factor of 99.9"),
        (9999.9, 1e5, "within 9990 m of the answer's, and for unknown scales within a factor of 100000"),
        (12345.6, 123456.7, "within 12.3 km of the answer's, and for unknown scales within a factor of 123000"),
        (2.5e12, 1.239e9, "within 2.5e+09 km of the answer's, and for unknown scales within a factor of 1.23e+09"),
    ],
)
def test_a_region_is_never_said_to_be_larger_than_it_is(radius_m: float, factor: float, said: str) -> None:
    assert str(Region(radius_m, factor)).endswith(said)


def test_nothing_can_be_changed_afterwards() -> None:
    with pytest.raises(FrozenInstanceError):
        CERTIFIED.cost = 0.0  # type: ignore[misc]


class TestMerged:
    def test_the_weakest_claim_counts(self) -> None:
        """The region is what all parts have in common, and the basis the weakest; a part without a region has all."""
        parts = [
            replace(CERTIFIED, basis=Basis.MEASUREMENTS),
            replace(CERTIFIED, basis=Basis.MEASUREMENTS, region=Region(300.0, 1e4)),
            replace(CERTIFIED, basis=Basis.MOMENTS, region=Region(500.0, 100.0)),
        ]
        assert Certificate.merged(parts[:2]).region == Region(300.0, 1e4)
        assert Certificate.merged(parts[:2]).basis is Basis.MEASUREMENTS
        assert Certificate.merged(parts).region == Region(300.0, 100.0)
        assert Certificate.merged(parts).basis is Basis.MOMENTS
        assert Certificate.merged([parts[0], parts[0]]).region is None

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
            assert both.cost == pytest.approx(150.0, rel=1e-15)
            assert both.cost >= 150.0
            assert both.lower_bound == pytest.approx(140.0 - 1e-6)
            assert both.float_bound == pytest.approx(145.0)
            assert both.min_eigenvalue == -3.0
            assert both.tolerance == pytest.approx(2e-4)
            assert both.seconds == {"descent": 1.5, "small dual": 2.0}
            assert (both.cause, both.path) == (other.cause, other.path)
            assert both.reason == f"2 unconnected parts, solved separately; {other.reason}"
