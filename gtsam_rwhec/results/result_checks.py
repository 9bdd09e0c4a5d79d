"""What must hold between the fields of a result file, so that no damaged or edited file passes for a calibration.

Every function raises `ValueError` with the JSON path, what was found, and what must be there.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.verdict import Ground, Judgement, Verdict
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.files.terminal_text import brief, shown
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.reprojection_record import SIZE, BoardShape, Intrinsics, Regions, lens_of
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.acceptance_record import Acceptance, Answer
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.schema import RefinedFields, SolutionFields
from gtsam_rwhec.solver.certificate import Certificate, Status

#: Largest share by which sums of the same doubles in another order may differ.
ROUNDING = 1e-9
#: Largest difference of two mirrored elements of a covariance, over the root of the product of their variances.
SYMMETRY = 1e-9
#: An eigenvalue of a matrix of correlations may be below zero by this much times its size: rounding.
SEMIDEFINITE = 1e-10
#: Largest difference of an element of F'F from the identity for free directions F, which are orthonormal.
ORTHONORMAL = 1e-6
#: Focal lengths and principal point: the parameters of a camera without distortion.
FEWEST_PARAMETERS = 4


def check_certificates(solution: SolutionFields) -> None:
    """Each certificate proves what it says, and the whole is the sum of the parts."""
    place = "$.certified.certificate"
    whole = solution.certificate
    _check_certificate(whole, place)
    for index, part in enumerate(solution.parts):
        _check_certificate(part.certificate, f"$.certified.parts[{index}].certificate")
    if whole.status is Status.CERTIFIED and solution.identifiability.free_directions:
        number = len(solution.identifiability.free_directions)
        raise ValueError(f"{place}.status: 'certified', but identifiability has {number} free directions")
    if solution.identifiability.is_unique and solution.identifiability.free_directions:
        raise ValueError("$.certified.identifiability.is_unique: true, but there are free directions")
    if not solution.parts:
        return
    sums = Certificate.merged([part.certificate for part in solution.parts])
    for name in ("status", "basis", "objective", "region"):
        if getattr(whole, name) != getattr(sums, name):
            raise ValueError(f"{place}.{name}: must be what all parts make, {getattr(sums, name)}")
    for name in ("cost", "lower_bound", "tolerance"):
        one, other = getattr(whole, name), getattr(sums, name)
        if not math.isclose(one, other, rel_tol=ROUNDING):
            raise ValueError(f"{place}.{name}: must be {other}, the sum of all parts (found {one})")


def _check_certificate(certificate: Certificate, place: str) -> None:
    cost, bound, tolerance = certificate.cost, certificate.lower_bound, certificate.tolerance
    if not (tolerance >= 0.0 and cost >= -tolerance and bound - cost <= tolerance):
        raise ValueError(
            f"{place}: a sum of squares of {cost}, a lower bound of {bound} and a tolerance of {tolerance} are "
            "impossible together"
        )
    region = certificate.region
    if region is not None and not (region.radius_m > 0.0 and region.scale_factor >= 1.0):
        raise ValueError(f"{place}.region: radius_m must be positive and scale_factor at least 1")
    if certificate.is_optimal and not cost - bound <= tolerance:
        raise ValueError(
            f"{place}.status: '{certificate.status}', but the cost, {cost}, is above the lower bound, {bound}, by more "
            f"than the tolerance, {tolerance}"
        )
    if certificate.status is not certificate.cause.status:
        status, cause = certificate.cause.status, certificate.cause
        raise ValueError(f"{place}.status: must be '{status}' with the cause '{cause}' (found '{certificate.status}')")
    try:
        certificate.reason  # noqa: B018 - its words are made of the figures
    except KeyError as error:
        words = f"lacks {error.args[0]}, of which the cause '{certificate.cause}' speaks"
        raise ValueError(f"{place}.figures: {words}") from error


def check_verdict(stated: Verdict, grounds: tuple[Ground, ...], found: Judgement) -> None:
    """The verdict of a file, and its grounds, are what its facts lead to."""
    if (stated, grounds) != (found.verdict, found.grounds):
        names = [", ".join(each) or "none" for each in (grounds, found.grounds)]
        raise ValueError(
            f"$.verdict: the file says '{stated.value}' (grounds: {names[0]}), but its content leads to "
            f"'{found.verdict.value}' ({names[1]}); write it again"
        )


def check_acceptance(acceptance: tuple[Acceptance, ...], sensors: Collection[str]) -> None:
    """Each acceptance is of a sensor of the file, and its answer is the one that its bounds lead to."""
    names = [one.sensor for one in acceptance]
    _check_are_there(names, sensors, "$.acceptance", "sensors")
    for index, one in enumerate(acceptance):
        place = f"$.acceptance[{index}]"
        if names.count(one.sensor) > 1:
            raise ValueError(f"{place}.sensor: {shown(one.sensor)} is there twice; keep one")
        for name in ("estimate_mm", "upper_mm", "lower_mm", "known_to_mm", "noise_mm", "degrees_of_freedom", "more"):
            _check_not_negative(getattr(one, name), f"{place}.{name}")
        _check_not_negative(one.volume.half_m, f"{place}.volume.half_m")
        if not (one.limit_mm > 0.0 and 0.0 < one.level < 1.0 and one.count > 0):
            raise ValueError(
                f"{place}: a limit of {one.limit_mm} mm, level {one.level} and {one.count} {one.of} test nothing"
            )
        if not one.lower_mm <= one.upper_mm:
            raise ValueError(f"{place}.lower_mm: {one.lower_mm} is above upper_mm, {one.upper_mm}")
        leads_to = Answer.REJECTED if one.lower_mm > one.limit_mm else Answer.NOT_YET
        if one.upper_mm < one.limit_mm:
            leads_to = Answer.ACCEPTED
        elif math.isinf(one.upper_mm):
            leads_to = Answer.NOT_DETERMINED
        if one.answer is not leads_to:
            raise ValueError(
                f"{place}.answer: '{one.answer}', but the limit, {one.limit_mm} mm, and the bounds, {one.lower_mm} to "
                f"{one.upper_mm} mm, lead to '{leads_to}'"
            )


def check_log(log: LogFields) -> None:
    """Each count of a log is there once."""
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


def check_sizes(solution: SolutionFields, refined: RefinedFields | None) -> None:
    """Root mean squares, counts and costs are not negative; scales are of one kind, unless corners estimate sizes."""
    _check_not_negative(solution.residuals, "$.certified.residuals")
    for answer, place in ((solution, "$.certified.scale"), (refined, "$.scale")):
        if answer is not None and answer.scale_mode == "known" and answer.scale != 1.0:
            raise ValueError(f"{place}: must be 1.0 with scale_mode 'known' (found {answer.scale})")
    if refined is None:
        return
    for name in ("cost", "initial_cost", "iterations", "noise", "reprojection", "intrinsics"):
        _check_not_negative(getattr(refined, name), f"$.refined.{name}")
    for pair, (inliers, number) in refined.inlier_counts.items():
        if not 0 <= inliers <= number:
            raise ValueError(f"$.refined.inlier_counts[{shown(pair)}]: {inliers} inliers of {number} measurements")
    has_sizes = any(SIZE in board.names for board in _boards(refined).values())
    is_of_corners = refined.scale_mode == "per_target" and solution.scale_mode == "known" and has_sizes
    if refined.scale_mode != solution.scale_mode and not is_of_corners:
        raise ValueError(
            f"$.scale_mode: must be '{solution.scale_mode}', as in $.certified (found '{refined.scale_mode}')"
        )
    for what, name in (("targets", "X"), ("sensors", "Y")):
        if getattr(refined, name).keys() != getattr(solution, name).keys():
            raise ValueError(f"$.{what}: must have the same names as $.certified.{what}")


def check_joint(refined: RefinedFields, certified: SolutionFields) -> None:
    """Each unknown has its own rows of the joint covariance, and there are no other rows."""
    names = refined.X.keys() | refined.Y.keys()
    if refined.frames.keys() != names:
        raise ValueError(f"$.refined.frames: must have the targets and sensors {', '.join(sorted(names))}")
    slots, place = refined.joint.slots, "$.refined.joint.slots"
    boards = _boards(refined)
    owners = {
        UnknownKind.FRAME: names,
        UnknownKind.TIME_OFFSET: refined.time_offsets_s,
        UnknownKind.SCALE: _scale_owners(refined),
        UnknownKind.INTRINSICS: refined.intrinsics,
        UnknownKind.SHAPE: boards,
    }
    strangers = [str(unknown) for unknown in slots if unknown.owner not in owners[unknown.kind]]
    if strangers:
        raise ValueError(f"{place}: unknowns that have no value: {', '.join(sorted(strangers))}")
    missing = [
        str(unknown)
        for kind in (UnknownKind.FRAME, UnknownKind.TIME_OFFSET, UnknownKind.SCALE)
        for unknown in (Unknown(kind, name) for name in owners[kind])
        if unknown not in slots and not _may_be_known(unknown, refined, certified)
    ]
    if missing:
        raise ValueError(f"{place}: unknowns that have no rows: {', '.join(sorted(missing))}")
    end = 0
    for unknown, rows in sorted(slots.items(), key=lambda item: item[1].start):
        width = unknown.dimension
        if unknown.kind is UnknownKind.INTRINSICS:
            width = len(refined.intrinsics[unknown.owner].names)
        elif unknown.kind is UnknownKind.SHAPE:
            width = len([name for name in boards[unknown.owner].names if name != SIZE])
        if (rows.start, rows.stop) != (end, end + width):
            raise ValueError(
                f"{place}.{unknown}: must be [{end}, {end + width}], because rows may neither overlap nor "
                f"be left out (found [{rows.start}, {rows.stop}])"
            )
        end = rows.stop
    _check_matrices(refined.joint, end)


def _boards(refined: RefinedFields) -> dict[str, BoardShape]:
    return {} if refined.reprojection is None else refined.reprojection.boards


def _scale_owners(refined: RefinedFields) -> Collection[str]:
    if refined.scale_mode == "known":
        return ()
    return refined.scale if isinstance(refined.scale, dict) else ("",)


def _may_be_known(unknown: Unknown, refined: RefinedFields, certified: SolutionFields) -> bool:
    """Frames with a pose that refinement did not change, and such scales: they may be stated."""
    name = unknown.owner
    if unknown.kind is UnknownKind.FRAME:
        one, other = ((each.Y if name in each.Y else each.X)[name] for each in (refined, certified))
        return bool((one.matrix() == other.matrix()).all())
    if unknown.kind is UnknownKind.SCALE and isinstance(refined.scale, dict):
        before = certified.scale if isinstance(certified.scale, dict) else {name: certified.scale}
        return refined.scale[name] == before.get(name)
    return False


def _check_matrices(joint: JointCovariance, size: int) -> None:
    shapes = joint.unit.shape, joint.finite.shape, joint.free.shape[:1]
    if shapes != ((size,), (size, size), (size,)):
        raise ValueError(f"$.refined.joint: slots have {size} rows, but unit, finite and free are {shapes}")
    variances = np.diagonal(joint.finite)
    for i in np.flatnonzero(variances < 0.0)[:1]:
        raise ValueError(f"$.refined.joint.finite[{i}][{i}]: a variance is not negative (found {variances[i]})")
    deviations = np.sqrt(variances)
    with np.errstate(over="ignore", invalid="ignore"):  # an infinite number is none that a covariance has
        difference = np.abs(joint.finite - joint.finite.T)
        gram = joint.free.T @ joint.free
    for i, j in np.argwhere(difference > SYMMETRY * np.outer(deviations, deviations))[:1]:
        raise ValueError(
            f"$.refined.joint.finite[{i}][{j}]: a covariance is symmetric, but [{j}][{i}] is {joint.finite[j, i]} "
            f"(found {joint.finite[i, j]})"
        )
    if not _is_semidefinite(joint.finite, deviations):
        raise ValueError("$.refined.joint.finite: not positive semidefinite, so it is the covariance of nothing")
    if not np.abs(gram - np.eye(len(gram))).max(initial=0.0) <= ORTHONORMAL:  # NaN is not
        raise ValueError("$.refined.joint.free: its columns, the free directions, must be orthonormal")


def _is_semidefinite(covariance: Array, deviations: Array) -> bool:
    """Whether the correlations have no eigenvalue below zero; a row of zeros must be zero throughout."""
    unit = np.where(deviations > 0.0, deviations, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        correlations = covariance / unit[:, None] / unit
    if not np.isfinite(correlations).all():
        return False
    np.fill_diagonal(correlations, 1.0 + SEMIDEFINITE * len(unit))
    try:
        np.linalg.cholesky(correlations)
    except np.linalg.LinAlgError:
        return False
    return True


def check_corners(refined: RefinedFields) -> None:
    """Cameras, boards and errors in pixels belong to frames of the file, and each of them is whole."""
    found, place = refined.reprojection, "$.refined.reprojection"
    _check_are_there(refined.intrinsics, refined.Y if found is not None else (), "$.refined.intrinsics", "sensors")
    if found is None:
        return
    _check_are_there(found.sensors, refined.Y, f"{place}.sensors", "sensors")
    _check_are_there(found.boards, refined.X, f"{place}.boards", "targets")
    for index, one in enumerate(found.consequences):
        _check_are_there(
            [one.frame], refined.X.keys() | refined.Y.keys(), f"{place}.consequences[{index}].frame", "frames"
        )
    for name, sensor in found.sensors.items():
        _check_regions(sensor.regions_px, f"{place}.sensors.{shown(name)}.regions_px")
    if found.tried and sum(tried.is_chosen for tried in found.tried) != 1:
        raise ValueError(f"{place}.tried: one model is chosen")
    for name, intrinsics in refined.intrinsics.items():
        _check_intrinsics(intrinsics, refined, f"$.refined.intrinsics.{shown(name)}")
    for name, board in found.boards.items():
        _check_board(board, f"{place}.boards.{shown(name)}")


def _check_intrinsics(intrinsics: Intrinsics, refined: RefinedFields, place: str) -> None:
    width = len(intrinsics.names)
    if width < FEWEST_PARAMETERS:
        raise ValueError(f"{place}.names: a camera has at least {FEWEST_PARAMETERS} parameters (found {width})")
    for what in ("values", "standard_deviations", "stated", "stated_deviations"):
        if len(getattr(intrinsics, what)) != width:
            raise ValueError(f"{place}.{what}: {len(getattr(intrinsics, what))} numbers for {width} names")
    for what, values in (("camera", "values"), ("stated_camera", "stated")):
        try:
            getattr(intrinsics, what)
        except CameraError as error:
            raise ValueError(f"{place}.{values}: no camera has them: {error}") from error
    wanted = replace(lens_of(intrinsics), D=np.zeros(width - FEWEST_PARAMETERS)).parameter_names
    if intrinsics.names != wanted:
        raise ValueError(
            f"{place}.names: must be {', '.join(wanted)} (found {', '.join(map(shown, intrinsics.names))})"
        )
    _check_are_there(intrinsics.held_by_prior, intrinsics.names, f"{place}.held_by_prior", "parameters")
    _check_are_there(intrinsics.not_free, intrinsics.names, f"{place}.not_free", "parameters")
    _check_are_there(intrinsics.shared_with, refined.intrinsics, f"{place}.shared_with", "cameras")
    _check_regions(intrinsics.projection_px, f"{place}.projection_px")


def _check_board(board: BoardShape, place: str) -> None:
    if not len(board.names) == len(set(board.names)) == len(board.values) == len(board.standard_deviations):
        raise ValueError(f"{place}: names, values and standard_deviations must have one entry each for every number")
    off, of_off = board.corners_off_m, board.corners_deviations_m
    if len(off) != len(of_off) or any(len(each) != 3 for each in (*off, *of_off)):
        raise ValueError(f"{place}: corners_off_m and corners_deviations_m must have x, y, z of every corner")


def _check_regions(regions: Regions, place: str) -> None:
    if len({len(row) for row in regions}) > 1:
        raise ValueError(f"{place}: rows of different lengths")


#: Fields whose numbers may be below zero.
OF_EITHER_SIGN = ("values", "stated", "corners_off_m")


def _check_not_negative(value: object, place: str) -> None:
    """No number in records, lists or dictionaries is below zero, but those of `OF_EITHER_SIGN`."""
    if is_dataclass(value):
        for each in fields(value):
            if each.name not in OF_EITHER_SIGN:
                _check_not_negative(getattr(value, each.name), f"{place}.{each.name}")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            _check_not_negative(item, f"{place}.{shown(key)}" if isinstance(key, str) else f"{place}[{shown(key)}]")
    elif isinstance(value, list | tuple):
        for item in value:
            _check_not_negative(item, place)
    elif isinstance(value, int | float) and not value >= 0:
        raise ValueError(f"{place}: must not be negative (found {value})")


def _check_are_there(names: Iterable[str], there: Collection[str], place: str, what: str) -> None:
    strangers = [name for name in names if name not in there]
    if strangers:
        has, are = (", ".join(map(shown, each)) or "none" for each in (strangers, there))
        raise ValueError(f"{place}: has {has}, but the {what} are {are}")
