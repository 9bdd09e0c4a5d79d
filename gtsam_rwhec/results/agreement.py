"""Facts that a result file states twice, or that follow from one another: they must agree.

`gtsam_rwhec.results.covariance_agreement` does the same for covariances.

Every function raises `ValueError` with the JSON path, what was found, and what the file says elsewhere.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

from gtsam_rwhec.calibration.outliers import HALF, NEARLY_HALF
from gtsam_rwhec.calibration.verdict import Ground, Judgement, Verdict
from gtsam_rwhec.files.terminal_text import brief, shown
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import SIZE
from gtsam_rwhec.results.json_tree import POSED
from gtsam_rwhec.results.log_history import LogFields, contradictions
from gtsam_rwhec.results.schema import RefinedFields, SolutionFields
from gtsam_rwhec.solver.certificate import Cause, Certificate, Status
from gtsam_rwhec.solver.solution import Solution

#: Largest share by which sums of the same doubles in another order may differ.
ROUNDING = 1e-9
#: Up to this version these grounds asked for care alone; after it, such poses are not to be used.
LAST_WITH_CARE = 5
ONCE_CALLED = {Ground.TARGET_CONTRADICTED: Ground.CONTRADICTED}
ONCE_CARE = {Ground.NOT_CERTIFIED, Ground.SIZE_DOUBTED}


def check_top(tree: Mapping[str, Any]) -> None:
    """Without refined poses, the poses and the scale at the top of a file are the certified ones."""
    for name in POSED:
        if name not in tree:
            raise ValueError(f"$.{name}: Field required")
        if _text(tree[name]) != _text(tree["certified"][name]):
            given = _text(tree[name])
            value = f" (found {given})" if len(given) <= 60 else ""
            raise ValueError(
                f"$.{name}: differs from $.certified.{name}{value}, but the file has no refined poses; write it again"
            )


def check_certificates(solution: SolutionFields) -> None:
    """Each certificate says what its cause, cost and bound say, and the whole is the sum of the parts.

    Files of versions 1 to 3 have no causes.
    """
    whole, place = solution.certificate, "$.certified.certificate"
    _check_certificate(whole, place)
    for index, part in enumerate(solution.parts):
        _check_certificate(part.certificate, f"$.certified.parts[{index}].certificate")
    if solution.cost != whole.cost:
        raise ValueError(f"$.certified.cost: must be {whole.cost}, the cost of the certificate (found {solution.cost})")
    if solution.is_relative is not whole.is_relative:
        raise ValueError(f"$.certified.is_relative: must be {whole.is_relative}, as in the certificate")
    if whole.status is Status.CERTIFIED and solution.identifiability.free_directions:
        number = len(solution.identifiability.free_directions)
        raise ValueError(f"{place}.status: 'certified', but identifiability has {number} free directions")
    if solution.identifiability.is_unique and solution.identifiability.free_directions:
        raise ValueError("$.certified.identifiability.is_unique: true, but there are free directions")
    if solution.parts:
        sums = Certificate.merged([part.certificate for part in solution.parts])
        _check_sum(whole, sums, place)
        if whole.basis is not sums.basis:
            raise ValueError(f"{place}.basis: must be '{sums.basis}', the weakest of all parts (found '{whole.basis}')")
        if whole.objective != sums.objective:
            raise ValueError(
                f"{place}.objective: must be what the parts make, {sums.objective} (found {whole.objective})"
            )
        if whole.region != sums.region:
            region = (
                "null"
                if sums.region is None
                else f"radius_m {sums.region.radius_m}, scale_factor {sums.region.scale_factor}"
            )
            raise ValueError(f"{place}.region: must be what all parts have in common, {region}")


def check_says_what_it_is_about(raw: dict[str, Any]) -> None:
    """A certificate of version 5 and later has both fields that limit it: without one it would claim too much."""
    certified = raw.get("certified")
    if not isinstance(certified, dict):
        return  # said by the schema
    of_parts = certified.get("parts")
    parts: list[Any] = of_parts if isinstance(of_parts, list) else []
    owners = [("$.certified", certified)] + [(f"$.certified.parts[{i}]", part) for i, part in enumerate(parts)]
    for place, owner in owners:
        certificate = owner.get("certificate") if isinstance(owner, dict) else None
        if isinstance(certificate, dict):
            for name in ("basis", "region"):
                if name not in certificate:
                    raise ValueError(f"{place}.certificate.{name}: is missing")


def check_sizes(solution: SolutionFields, refined: RefinedFields | None) -> None:
    """Root mean squares, counts, movements and costs are not negative, and no more are inliers than there are.

    Scales are of one kind, but that corners may estimate sizes that count as known before.
    """
    for pair, residual in solution.residuals.items():
        place = f"$.certified.residuals[{shown(pair)}]"
        _check_least(residual.number_of_measurements, 1, f"{place}.number_of_measurements")
        _check_least(residual.translation_rms_m, 0, f"{place}.translation_rms_m")
        _check_least(residual.rotation_rms_rad, 0, f"{place}.rotation_rms_rad")
        counted = solution.identifiability.pairs[pair].number_of_measurements
        if counted != residual.number_of_measurements:
            raise ValueError(
                f"{place}.number_of_measurements: must be {counted}, as in identifiability.pairs (found "
                f"{residual.number_of_measurements})"
            )
    if refined is None:
        return
    for name in ("cost", "initial_cost", "iterations"):
        _check_least(getattr(refined, name), 0, f"$.refined.{name}")
    for name, movement in refined.moved.items():
        _check_least(movement.translation_mm, 0, f"$.refined.moved.{shown(name)}.translation_mm")
        _check_least(movement.rotation_deg, 0, f"$.refined.moved.{shown(name)}.rotation_deg")
    for pair, noise in refined.noise.items():
        _check_least(noise.rotation_rad, 0, f"$.refined.noise[{shown(pair)}].rotation_rad")
        _check_least(noise.translation_m, 0, f"$.refined.noise[{shown(pair)}].translation_m")
        _check_least(min(noise.degrees_of_freedom), 0, f"$.refined.noise[{shown(pair)}].degrees_of_freedom")
    for pair, (inliers, number) in refined.inlier_counts.items():
        if not 0 <= inliers <= number:
            raise ValueError(f"$.refined.inlier_counts[{shown(pair)}]: {inliers} inliers of {number} measurements")
    found = refined.reprojection
    are_of_corners = refined.scale_mode == "per_target" and solution.scale_mode == "known"
    are_of_corners &= found is not None and any(SIZE in board.names for board in found.boards.values())
    if refined.scale_mode != solution.scale_mode and not are_of_corners:
        raise ValueError(
            f"$.scale_mode: must be '{solution.scale_mode}', as in $.certified (found '{refined.scale_mode}')"
        )
    for name in ("X", "Y"):
        if getattr(refined, name).keys() != getattr(solution, name).keys():
            what = "targets" if name == "X" else "sensors"
            raise ValueError(f"$.{what}: must have the same names as $.certified.{what}")


def check_scale(answer: Solution | RefinedPoses, place: str) -> None:
    """A known scale is 1."""
    if answer.scale_mode == "known" and answer.scale != 1.0:
        raise ValueError(f"{place}: must be 1.0 with scale_mode 'known' (found {answer.scale})")


def check_verdict(stated: Verdict, grounds: tuple[Ground, ...], found: Judgement, version: int) -> None:
    """The verdict of a file, and its grounds, are what its facts lead to.

    Up to version 5 an answer that was not proven, and a doubted size, asked for care, and nobody asked for sensors
    without an answer.
    """
    led_to, found_grounds = found.verdict, found.grounds
    if version <= LAST_WITH_CARE:
        once = (ONCE_CALLED.get(ground, ground) for ground in found.grounds if ground is not Ground.NO_ANSWER)
        found_grounds = tuple(dict.fromkeys(once))
        led_to = Verdict.USE
        if found_grounds:
            led_to = Verdict.CARE if set(found_grounds) <= ONCE_CARE else Verdict.DO_NOT_USE
    if stated is not led_to:
        raise ValueError(
            f"$.verdict: the file says '{stated.value}', but its content leads to '{led_to.value}'; write it again"
        )
    if grounds != found_grounds:
        names = [", ".join(each) or "none" for each in (grounds, found_grounds)]
        raise ValueError(
            f"$.verdict_grounds: the file says {names[0]}, but its content leads to {names[1]}; write it again"
        )


def check_log(log: LogFields, version: int) -> None:
    """The frames that most measurements contradict are those of the counts, and each count is there once.

    Up to version 5 these were frames of which more than half of the measurements were left out.
    """
    for name, rows in (
        ("outliers", [str(row.pair) for row in log.outliers]),
        ("sizes", [row.target for row in log.sizes]),
        ("time_offsets", [row.sensor for row in log.time_offsets]),
        ("detection.tracks", [str(row.pair) for row in log.detection.tracks]),
        ("cleaning.tracks", [str(row.pair) for row in log.cleaning.tracks]),
    ):
        twice = [each for each, number in Counter(rows).items() if number > 1]
        if twice:
            raise ValueError(f"$.log.{name}: {brief(twice[0])} is there twice; keep one")
    found = contradictions(log.outliers, HALF if version <= LAST_WITH_CARE else NEARLY_HALF)
    if log.contradicted != found:
        frames = [", ".join(shown(row.frame) for row in each) or "none" for each in (log.contradicted, found)]
        raise ValueError(f"$.log.contradicted: must be {frames[1]}, by $.log.outliers (found {frames[0]})")


def _check_certificate(certificate: Certificate, place: str) -> None:
    _check_bound(certificate, place)
    cause, status = certificate.cause, certificate.status
    if cause is not Cause.NOT_RECORDED and status is not cause.status:
        raise ValueError(f"{place}.status: must be '{cause.status}' with the cause '{cause}' (found '{status}')")
    try:
        certificate.reason  # noqa: B018 - its words are made of the figures
    except KeyError as error:
        raise ValueError(f"{place}.figures: lacks {error.args[0]}, of which the cause '{cause}' speaks") from error


def _check_bound(certificate: Certificate, place: str) -> None:
    cost, bound, tolerance = certificate.cost, certificate.lower_bound, certificate.tolerance
    if not tolerance >= 0.0:
        raise ValueError(f"{place}.tolerance: must be at least 0 (found {tolerance})")
    if cost < -tolerance:
        raise ValueError(f"{place}.cost: a sum of squares is not negative (found {cost})")
    region = certificate.region
    if region is not None and not (region.radius_m > 0.0 and region.scale_factor >= 1.0):
        raise ValueError(
            f"{place}.region: its radius_m must be positive and its scale_factor at least 1 (found "
            f"{region.radius_m} and {region.scale_factor})"
        )
    if bound - cost > tolerance:
        raise ValueError(f"{place}.lower_bound: {bound} is above the cost, {cost}, of an answer")
    if certificate.is_optimal and not cost - bound <= tolerance:
        raise ValueError(
            f"{place}.status: '{certificate.status}', but the cost, {cost}, is above the lower bound, {bound}, by more "
            f"than the tolerance, {tolerance}"
        )


def _check_sum(whole: Certificate, sums: Certificate, place: str) -> None:
    """Sums of doubles depend on their order, so they may differ by rounding."""
    if whole.status is not sums.status:
        raise ValueError(f"{place}.status: must be '{sums.status}', the worst of all parts (found '{whole.status}')")
    for name in ("cost", "lower_bound", "tolerance"):
        one, other = getattr(whole, name), getattr(sums, name)
        if not math.isclose(one, other, rel_tol=ROUNDING):
            raise ValueError(f"{place}.{name}: must be {other}, the sum of all parts (found {one})")


def _check_least(value: float, least: int, place: str) -> None:
    if not value >= least:
        raise ValueError(f"{place}: must be at least {least} (found {value})")


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True)
