"""``rw.accept``: that a calibration is off by less than a limit, from touched points or from a board that is new to it.

What is tested is the pose of one sensor on its carrier: an error of it is the same small motion in every pose of the
robot. `gtsam_rwhec.results.equivalence_test` has the test and its source. A board need not have a known place: where
each is on the targets' carrier is unknown too, and only its centre is used, since a board's tilt is seen badly.

First the touched points, which a sensor measured, and their CSV file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.point_uncertainty import checked_level
from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import CountError, FileFormatError, FrameError, OptionError, PoseError
from gtsam_rwhec.files.terminal_text import brief, rounded, shown
from gtsam_rwhec.files.whole_files import read_whole, write_atomically
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import LARGEST_M, Array, PosesLike, as_transforms, checked_rows, rows_to_transforms
from gtsam_rwhec.geometry.real_numbers import is_between, real_array
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.acceptance_record import Acceptance, Answer, Volume
from gtsam_rwhec.results.changed_frames import as_result
from gtsam_rwhec.results.equivalence_test import ErrorFit, TouchRows, VolumeTest, best_places, error_rows, fit_error
from gtsam_rwhec.results.evidence import checksum, evidence_path, read_evidence, write_evidence
from gtsam_rwhec.results.file_record import triple
from gtsam_rwhec.results.json_tree import MOST_BYTES, to_json
from gtsam_rwhec.results.result_file import Result, encoded, parse_result, parse_tree, result_of, result_path

#: The columns of a file of touches; the last seven may be left out.
POINTS = ("sensor_x_m", "sensor_y_m", "sensor_z_m", "known_x_m", "known_y_m", "known_z_m")
POSES = ("A_qw", "A_qx", "A_qy", "A_qz", "A_x_m", "A_y_m", "A_z_m")
#: A file of touches has at most this many bytes.
MOST_OF_TOUCHES = 50_000_000


#: No sensor's touched points are farther away, metres.
FARTHEST_M = 100.0


@dataclass(frozen=True, eq=False)
class Touches:
    """Known points that a sensor measured."""

    sensor_m: Array  #: (n, 3): the points in the sensor's frame, as it measured them, metres
    #: (n, 3): the same points as they are known (the robot's pose times the tool tip), metres: in the frame that
    #: carries the sensor; with ``A`` in the frame that carries the targets
    known_m: Array
    #: (n, 4, 4): T_sensorcarrier_targetcarrier at the moment at which the sensor measured each point; None: not needed
    A: Array | None = None
    source: str = ""  #: The file's name

    @staticmethod
    def of(sensor_m: ArrayLike, known_m: ArrayLike, A: PosesLike | None = None, source: str = "") -> Touches:
        """Checked touches; points (n, 3) in metres, and poses as ``Problem.add`` takes them (quaternions w first)."""
        points = []
        for name, given in (("sensor_m", sensor_m), ("known_m", known_m)):
            try:
                array = real_array(given)
            except ValueError as error:
                raise PoseError(f"{name} cannot be read as numbers: {error}") from error
            if array.ndim != 2 or array.shape[1:] != (3,) or not (np.abs(array) <= LARGEST_M).all():
                raise PoseError(f"{name} has the shape {array.shape}; give (n, 3) finite numbers, metres")
            points.append(array)
        away_m = float(np.median(np.linalg.norm(points[0], axis=1))) if len(points[0]) else 0.0
        if away_m > FARTHEST_M:
            raise PoseError(f"the points of the sensor are {away_m:.4g} m away (median): give metres, not millimetres")
        poses, where = None, f"A of {source or 'the touches'}"
        if A is not None:
            transforms = as_transforms(A, "wxyz" if np.ndim(A) == 2 else None, where)  # type: ignore[arg-type]
            poses = rows_to_transforms(checked_rows(transforms, 0, where).rows)
        counts = [len(each) for each in (*points, *([] if poses is None else [poses]))]
        if len(set(counts)) > 1 or not counts[0]:
            raise CountError(f"sensor_m, known_m and A have {', '.join(map(str, counts))} rows; give one of each touch")
        return Touches(points[0], points[1], poses, source)


def is_touches_file(path: str | Path) -> bool:
    """Whether a path names a CSV file, as touches are, and no folder; it may not be there."""
    return Path(path).suffix.lower() == ".csv" and not Path(path).is_dir()


def read_touches(path: str | Path) -> Touches:
    """Read a CSV file of touches: a header with the names `POINTS` (and `POSES`) in any order, one touch a line.

    Raises
    ------
    FileFormatError
        The file cannot be read, or a column or a number is missing or wrong; the message has the line.
    """
    path = Path(path)
    try:
        text = read_whole(path, MOST_OF_TOUCHES, "Touches were").decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path} is not a text file in UTF-8 (byte {error.start}).") from error
    lines = text.splitlines()
    if not text.strip():
        raise FileFormatError(f"{path} is empty: give a header with {', '.join(POINTS)} (metres), and touches below.")
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    wanted = (*POINTS, *POSES) if any(name in POSES for name in names) else POINTS
    if sorted(names) != sorted(wanted):
        raise FileFormatError(
            f"{path}, line 1: the columns are {brief(', '.join(names))}; give a header with {', '.join(POINTS)} "
            f"(metres), and, where known is in the frame that carries the targets, {', '.join(POSES)}."
        )
    rows = [_numbers(path, number, line, names) for number, line in enumerate(lines[1:], start=2) if line.strip()]
    if not rows:
        raise FileFormatError(f"{path} has no touches: give a line for each.")
    of = dict(zip(names, np.array(rows).T, strict=True))
    columns = [np.stack([of[name] for name in group], axis=1) for group in (POINTS[:3], POINTS[3:])]
    poses = np.stack([of[name] for name in POSES], axis=1) if wanted is not POINTS else None
    return Touches.of(columns[0], columns[1], poses, path.name)


def _numbers(path: Path, number: int, line: str, names: list[str]) -> list[float]:
    fields = [field.strip() for field in line.split(",")]
    if len(fields) != len(names):
        raise FileFormatError(f"{path}, line {number}: {len(fields)} fields in place of {len(names)}.")
    values = []
    for name, field in zip(names, fields, strict=True):
        try:
            value = float(field)
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST_M:
            raise FileFormatError(f"{path}, line {number}: {name} is {brief(field)}; give a finite number.")
        values.append(value)
    return values


#: The probability of the statement, unless another one is asked for.
LEVEL = 0.95
#: A volume whose worst corner is known so many times worse than the mean of all touches asks for other touches.
FAR = 20.0
#: Touches are on a line if their second principal deviation is below this share of the first; in a plane: the third.
FLAT = 0.02
#: So many places are proposed.
PLACES = 3
#: Of more boards, those that were seen most often count.
MOST_BOARDS = 50
#: No touch is better than this.
EXACT_M = 1e-9
#: Noise of more than so many limits is none: points that do not belong together.
UNLIKE = 20.0
#: A touch is named that is this rarely so far from the others.
RARE = 0.01


@one_blas_thread()
def accept(
    result: Result | Calibration,
    measured: Touches | Problem,
    *,
    limit_mm: float,
    sensor: str | None = None,
    volume: Volume | None = None,
    level: float = LEVEL,
    noise_mm: float | tuple[float, float] | None = None,
    known_to_mm: float = 0.0,
) -> Acceptance:
    """Whether the calibration of a sensor is off by less than a limit everywhere in a volume, with 95 %.

    This is an equivalence test: a calibration that is off by the limit or more is accepted in at most 5 % of all
    cases, however few touches there are. (That a test of "no error" finds nothing shows nothing.) It is an
    intersection-union test of one-sided t-tests: Schuirmann 1987, J. Pharmacokin. Biopharm. 15:657, in one dimension;
    Berger and Hsu 1996, Statistical Science 11:283. The size is exact for noise that is normal, of one deviation in all
    directions or stated; nearly so (Satterthwaite 1946) where the noise along the line of sight is estimated by itself.

    Parameters
    ----------
    result : Result (``rw.results.read_result``) or Calibration
    measured : Touches or Problem
        Known points that the sensor measured, or poses of boards from a log that the calibration was not made from.
        Their place on the targets' carrier may be unknown. The touches must be independent: never those of the
        calibration.
    limit_mm : float
        The largest allowed error of a point, millimetres.
    sensor : str, optional
        The sensor; needed if the calibration has several.
    volume : Volume, optional
        ``Volume.box(low_m, high_m)`` or ``Volume.ball(centre_m, radius_m)`` in the frame that carries the sensor. By
        default the box around the touched points.
    level : float
        The probability of the statement.
    noise_mm : float or (across, along), optional
        Standard deviation of one touch along each axis, mm; or across the sensor's line of sight, and along it. By
        default it is estimated from the residuals.
    known_to_mm : float
        Largest error that all known points may share (such as that of the tool tip), mm. It is added to the bound.

    Raises
    ------
    FrameError
        There is no such sensor, none is named of several, or nothing was measured by it.
    OptionError
        Limit, level, noise or volume cannot be used.
    """
    found = as_result(result)
    level = checked_level(level)
    for name, value, least in (("limit_mm", limit_mm, 1e-9), ("known_to_mm", known_to_mm, 0.0)):
        if not is_between(value, least, 1e6):
            raise OptionError(f"{name}={brief(value)}; give millimetres, {'more' if least else 'not less'} than 0")
    stated = _checked_noise(noise_mm)
    answer = found.refined or found.solution
    name = _checked_sensor(sensor, tuple(answer.Y))
    has_scale = not isinstance(answer.scale, dict) and answer.scale_mode != "known"
    if isinstance(measured, Problem):
        points, errors, others, sight = _of_boards(found, measured, name)
    elif isinstance(measured, Touches):
        points, errors, others, sight = _of_touches(found, measured, name)
    else:
        raise OptionError(f"measured is a {type(measured).__name__}; give rw.results.Touches.of(...) or a rw.Problem")
    given = volume
    volume = volume or Volume.box(points.min(axis=0), points.max(axis=0))
    corners_m = volume.corners_m
    centre = points.mean(axis=0)
    lever = max(float(np.linalg.norm(np.concatenate([corners_m, points]) - centre, axis=1).max()), 1e-9)
    rows, corners = (error_rows(each, centre, lever, has_scale=has_scale) for each in (points, corners_m))
    size = rows.shape[2]
    fit = fit_error(TouchRows(np.concatenate([rows, others], axis=2), size, errors, sight), stated)
    of_boards = isinstance(measured, Problem)
    test = VolumeTest(fit, corners, level)
    lacking, is_final = _lacking(test, points, is_stated=given is not None, of_boards=of_boards)
    limit_m, known_m = 1e-3 * limit_mm, 1e-3 * known_to_mm
    bound, corner = (None, 0) if math.isinf(test.amplification) else test.upper()
    lower_m = 0.0 if bound is None else max(0.0, test.lower_m() - known_m)
    if lower_m > limit_m:
        said = Answer.REJECTED
    elif bound is not None and not is_final and bound + known_m < limit_m:
        said = Answer.ACCEPTED
    else:
        said = Answer.NOT_DETERMINED if lacking else Answer.NOT_YET
    if said is Answer.NOT_DETERMINED:
        bound = None
    places = best_places(fit, corners, PLACES) if said in (Answer.NOT_YET, Answer.NOT_DETERMINED) else []
    return Acceptance(
        sensor=name,
        answer=said,
        limit_mm=float(limit_mm),
        level=level,
        volume=volume,
        of="views" if of_boards else "touches",
        count=fit.count,
        source="" if isinstance(measured, Problem) else measured.source,
        estimate_mm=math.inf if bound is None else 1e3 * test.estimate_m,
        upper_mm=math.inf if bound is None else 1e3 * (bound + known_m),
        lower_mm=1e3 * lower_m,
        worst_m=triple(corners_m[corner]),
        noise_mm=(1e3 * fit.noise_m[0], 1e3 * fit.noise_m[1]),
        noise="estimated" if fit.is_estimated else "stated",
        degrees_of_freedom=tuple(fit.freedoms.tolist()),
        known_to_mm=float(known_to_mm),
        scale_is_free=has_scale,
        more=test.needed(limit_m - known_m) if said is Answer.NOT_YET else None,
        places_m=tuple(triple(corners_m[index]) for index in dict.fromkeys(places)),
        lacking=lacking if said is Answer.NOT_DETERMINED else "",
        remarks=tuple(_remarks(found, fit, points, limit_m, given=given, stated=stated, of_boards=of_boards)),
    )


def _checked_noise(noise_mm: float | tuple[float, float] | None) -> tuple[float, float] | None:
    if noise_mm is None:
        return None
    both = (noise_mm, noise_mm) if not isinstance(noise_mm, Sequence) else tuple(noise_mm)
    if len(both) != 2 or not all(is_between(value, 1e-9, 1e6) for value in both):
        raise OptionError(f"noise_mm={brief(noise_mm)}; give one positive number, or (across, along), millimetres")
    return 1e-3 * both[0], 1e-3 * both[1]


def _checked_sensor(sensor: str | None, names: tuple[str, ...]) -> str:
    listed = ", ".join(map(shown, names))
    if sensor is None and len(names) > 1:
        raise FrameError(
            f"the calibration has the sensors {listed}; say which one is tested: --sensor NAME, sensor=NAME"
        )
    if sensor is not None and sensor not in names:
        raise FrameError(f"there is no sensor {brief(sensor)}; the calibration has {listed}")
    return names[0] if sensor is None else sensor


Equations = tuple[Array, Array, Array, Array]


def _of_touches(result: Result, touches: Touches, sensor: str) -> Equations:
    """Known points on the sensor's carrier, errors of the predictions, no further unknowns, and lines of sight."""
    answer = result.refined or result.solution
    scale = 1.0 if isinstance(answer.scale, dict) else float(answer.scale)
    T = answer.Y[sensor].matrix()
    known = touches.known_m
    if touches.A is not None:
        known = np.einsum("nij,nj->ni", touches.A[:, :3, :3], known) + touches.A[:, :3, 3]
    seen = touches.sensor_m / scale @ T[:3, :3].T
    return known, seen + T[:3, 3] - known, np.zeros((len(known), 3, 0)), _units(seen, T[:3, 2])


def _of_boards(result: Result, problem: Problem, sensor: str) -> Equations:
    """The same for the boards' centres; where each board is on the targets' carrier is unknown (three columns)."""
    problem.require_pairs()
    problem.require_raw_measurements("accept")
    answer = result.refined or result.solution
    T = answer.Y[sensor].matrix()
    pairs = [pair for pair in problem.pairs if pair.sensor == sensor and not pair.is_motion]
    if not pairs:
        raise FrameError(
            f"nothing in the new measurements is seen by {shown(sensor)}; they have the sensors "
            f"{', '.join(map(shown, problem.sensors))}"
        )
    pairs = sorted(pairs, key=lambda pair: len(problem.measurements(*pair).B), reverse=True)[:MOST_BOARDS]
    points, errors, others, sights = [], [], [], []
    for place, pair in enumerate(pairs):
        one = problem.measurements(*pair)
        scale = answer.scale.get(pair.target, 1.0) if isinstance(answer.scale, dict) else float(answer.scale)
        seen = one.B[:, :3, 3] / scale @ T[:3, :3].T
        at = seen + T[:3, 3]
        R, t = one.A[:, :3, :3], one.A[:, :3, 3]
        board = np.einsum("nji,nj->ni", R, at - t).mean(axis=0)
        columns = np.zeros((len(R), 3, 3 * len(pairs)))
        columns[:, :, 3 * place : 3 * place + 3] = R
        points.append(at)
        errors.append(at - (R @ board + t))
        others.append(columns)
        sights.append(_units(seen, T[:3, 2]))
    return np.concatenate(points), np.concatenate(errors), np.concatenate(others), np.concatenate(sights)


def _units(vectors: Array, otherwise: Array) -> Array:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(lengths > 0.0, vectors / np.maximum(lengths, 1e-300), otherwise)


def _lacking(test: VolumeTest, points: Array, *, is_stated: bool, of_boards: bool) -> tuple[str, bool]:
    """What the touches lack to tell the error in the volume, and what to do; empty if they tell it.

    And whether that stands however small the bound is: the box around touches on a line is no volume.
    """
    far = test.amplification > FAR
    if of_boards:
        words = (
            "the views do not tell the error in this volume; take more of them, with the carrier turned about two "
            "axes, and the board near the volume's corners"
        )
        return words if far else "", False
    if len(points) < 3:
        few = "one touch" if len(points) == 1 else "two touches"
        return f"{few} cannot tell it; touch 3 points or more, not on a line", not is_stated
    first, second, _ = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if second <= FLAT * first and (far or not is_stated):
        words = (
            "the touches lie on a line, and nothing tells how far off points beside it are; touch points away from the"
        )
        return f"{words} line", not is_stated
    if not far and test.fit.is_estimated and test.fit.freedoms.min() > 0.0 and test.fit.mean_variance_m2 < EXACT_M**2:
        return "the points agree to the last digit, so they were computed and not measured; measure them", True
    near = "the touches are too near to one another for this volume; touch points near its corners"
    return near if far else "", False


def _remarks(
    result: Result, fit: ErrorFit, points: Array, limit_m: float, *, given: Volume | None,
    stated: tuple[float, float] | None, of_boards: bool,
) -> list[str]:  # fmt: skip
    remarks = []
    if result.judgement.verdict is Verdict.DO_NOT_USE:
        remarks.append(f"the calibration's own verdict is another one: {result.judgement}")
    if fit.is_contradicted and stated is not None:
        remarks.append(
            f"the residuals are larger than the stated noise allows; the estimated one counts: "
            f"{rounded(1e3 * fit.noise_m[0])} mm across the line of sight and {rounded(1e3 * fit.noise_m[1])} mm along"
        )
    if fit.is_estimated and max(fit.noise_m) > UNLIKE * limit_m:
        remarks.append(
            f"the {'views' if of_boards else 'touches'} disagree with one another by {1e3 * max(fit.noise_m):.3g} mm, "
            "which is no noise: do both points of each line belong together (order, frames), and are all in metres?"
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if given is None and not of_boards and len(spread) == 3 and FLAT * spread[0] >= spread[2]:
        remarks.append(
            "the touches lie in a plane: touch points above and below it too, or state the volume in which the "
            "calibration is used"
        )
    if fit.is_estimated and len(fit.freedoms) == 1 and fit.freedoms[0] > 0.0:
        remarks.append(
            "from so few touches the noise counts as the same in all directions; if the sensor's depth is noisier than "
            "that, state noise_mm=(across, along)"
        )
    lengths = np.linalg.norm(fit.residuals_m, axis=1)
    largest = int(lengths.argmax())
    most = math.sqrt(fit.mean_variance_m2 * float(chdtri(3, RARE / len(lengths))))
    if lengths[largest] > most > 0.0:
        what = "view" if of_boards else "touch"
        remarks.append(f"{what} {largest + 1} is {1e3 * lengths[largest]:.2f} mm off the others: look at it")
    return remarks


def write_acceptance(found: Acceptance, path: str | Path) -> None:
    """Write an acceptance into the result file it is of (or the one in a folder), in place of an older one.

    Poses, covariances and verdict stay as they are; the evidence beside it stays its evidence. Raises FileFormatError
    if the file is no result, has no such sensor, or cannot be written.
    """
    path = result_path(path)
    content = read_whole(path, MOST_BYTES, "A result was")
    tree = parse_tree(content, path)
    result_of(tree, path)
    kept = [one for one in tree.get("acceptance", []) if one["sensor"] != found.sensor]
    tree["acceptance"] = [*kept, to_json(found, "$.acceptance")]
    new = encoded(tree)
    parse_result(new, path)
    beside = evidence_path(path)
    evidence = read_evidence(beside) if beside.exists() else None
    write_atomically(path, new)
    if evidence is not None and evidence.result_sha256 == checksum(content):
        write_evidence(evidence, beside, path)  # its checksum is that of the new file
