"""The result of a calibration of sensors that know only their own motion, and its words: the verdict first."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.found import Influence, JointCertificate, OtherAnswer, Windows
from gtsam_rwhec.odometry.tracks import OdometryNoise
from gtsam_rwhec.results.removed_measurements import Removed
from gtsam_rwhec.solver.certificate import Status
from gtsam_rwhec.solver.free_directions import FreeDirection


@dataclass(frozen=True)
class OdometryCalibration:
    """Poses of sensors that know only their own motion, and what is known of them. ``str()`` has the verdict first.

    Attributes
    ----------
    reference : str
        The sensor in whose frame the poses are.
    sensors : tuple of str
        All sensors, the reference first.
    T_reference_sensor : dict of sensor to (4, 4) array
        The identity for the reference. Along a free direction a pose is as the search left it.
    scales : dict of sensor to float
        Measured over true length, of the sensors of unknown scale.
    time_offsets_s : dict of sensor to float
        A sensor's stamp t is the reference's t + offset.
    time_offset_sigmas_s : dict of sensor to float
        Their standard deviations; empty where the clocks were not compared.
    order : tuple of str
        The sensors in the order of ``covariance``: all but the reference.
    covariance : (d, d) array
        Joint covariance: [omega, v] of each sensor in ``order`` (right perturbation, rad and m), then the logarithms of
        ``scales`` in their order. Infinite on the diagonal (and zero elsewhere in the row) where a free direction
        reaches.
    certificate : JointCertificate
    free_directions : tuple of FreeDirection
        How the answer can move while the measurements (and what was given) fit as well.
    windows : Windows
    noise : dict of sensor to OdometryNoise
        As it was stated or found.
    noise_was_found : frozenset of str
        The sensors whose noise was estimated.
    removed : dict of sensor to tuple of Removed
        Poses and windows that were not used, and why.
    residuals : dict of sensor to (rotation, translation)
        Root mean square of the windows' residuals, in their standard deviations: 1 is expected.
    influences : tuple of Influence
        How the answer depends on what was given.
    others : tuple of OtherAnswer
        Other answers that fit alike.
    contradictions : tuple of str
        Where tracks look wrong as a whole, or contradict a given distance, in sentences: the poses are not to be used.
    findings : tuple of str
        What is doubtful, in sentences: the verdict is to use the poses with care.
    remarks : tuple of str
        What was assumed, in sentences.
    """

    reference: str
    sensors: tuple[str, ...]
    T_reference_sensor: dict[str, Array] = field(hash=False)
    scales: dict[str, float] = field(hash=False)
    time_offsets_s: dict[str, float] = field(hash=False)
    time_offset_sigmas_s: dict[str, float] = field(hash=False)
    order: tuple[str, ...]
    covariance: Array = field(hash=False)
    certificate: JointCertificate
    free_directions: tuple[FreeDirection, ...]
    windows: Windows = field(hash=False)
    noise: dict[str, OdometryNoise] = field(hash=False)
    noise_was_found: frozenset[str]
    removed: dict[str, tuple[Removed, ...]] = field(hash=False)
    residuals: dict[str, tuple[float, float]] = field(hash=False)
    influences: tuple[Influence, ...] = ()
    others: tuple[OtherAnswer, ...] = ()
    contradictions: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def status(self) -> Status:
        """The certificate's status."""
        return self.certificate.status

    @property
    def is_unique(self) -> bool:
        """Whether measurements and what was given determine every pose."""
        return not self.free_directions and not self.others

    def covariance_of(self, sensor: str) -> Array:
        """The covariance (6, 6) of a sensor's pose, [omega, v], rad and m; zero for the reference."""
        if sensor == self.reference:
            return np.zeros((6, 6))
        first = 6 * self.order.index(sensor)
        block: Array = self.covariance[first : first + 6, first : first + 6]
        return block

    def T(self, first: str, second: str) -> Array:
        """The pose (4, 4) of sensor ``second`` in the frame of sensor ``first``: loops close exactly."""
        inverse = np.linalg.inv(self.T_reference_sensor[first])
        pose: Array = inverse @ self.T_reference_sensor[second]
        return pose

    def __str__(self) -> str:
        return _in_words(self)


def _verdict(found: OdometryCalibration) -> str:
    """The first sentence: whether the poses are to be used."""
    if not found.certificate.is_optimal:
        return "Do not use these poses: no proof that they are the best was found."
    if found.free_directions:
        return (
            "Do not use these poses: the drive does not determine all of them. What is free is below; "
            "drive other turns (slopes, ramps), or give heights, the ground, a direction or a distance."
        )
    if found.others:
        return "Do not use these poses: another answer fits as well. Look which of them is yours."
    if found.contradictions:
        return "Do not use these poses: tracks, or what was given, contradict one another."
    if any(one.is_contradicted for one in found.influences):
        return "Do not use these poses: what was given contradicts the motions. Measure it again."
    if found.findings:
        return "Use these poses with care: read the findings first."
    return "Use these poses."


def _in_words(found: OdometryCalibration) -> str:
    """All of it."""
    lines = [_verdict(found)]
    lines += [f"- free: {direction}" for direction in found.free_directions]
    lines += [f"- another answer: {other.why} (cost {other.cost_above:+.2g})" for other in found.others]
    lines += [f"- {finding}" for finding in (*found.contradictions, *found.findings)]
    lines += [f"- {remark}" for remark in found.remarks]
    lines.append(f"{found.certificate}")
    lines += [_sensor(found, name) for name in found.order]
    window = found.windows
    lines.append(f"{window.count} windows of {window.seconds:.3g} s; used: {_counts(window.used)}")
    for name in found.sensors:
        noise, how = found.noise[name], "found" if name in found.noise_was_found else "stated"
        lines.append(
            f"noise of {name} ({how}): {np.degrees(noise.rotation_rad_per_sqrt_s):.3g} deg and "
            f"{1e3 * noise.translation_m_per_sqrt_s:.3g} mm after a second"
        )
    for name, removed in found.removed.items():
        if removed:
            reasons = Counter(str(item.reason) for item in removed)
            lines.append(f"removed of {name}: {_counts(dict(reasons))}")
    for number in found.influences:
        size = max((float(np.linalg.norm(twist[3:])) for twist in number.per_sigma.values()), default=0.0)
        turn = max((float(np.linalg.norm(twist[:3])) for twist in number.per_sigma.values()), default=0.0)
        lines.append(
            f"given: {number.what} = {number.value:g} +- {number.sigma:g} {number.unit}; one sigma moves a sensor by "
            f"up to {1e3 * size:.2g} mm and {np.degrees(turn):.2g} deg; the data are {number.off_by:.1f} sigmas from it"
        )
    return "\n".join(lines)


def _sensor(found: OdometryCalibration, name: str) -> str:
    T, sigma = found.T_reference_sensor[name], np.sqrt(np.diagonal(found.covariance_of(name)))
    where = ", ".join(f"{x:.4f}" for x in T[:3, 3])
    text = (
        f"{name} in {found.reference}: at ({where}) m +- {_sizes(1e3 * sigma[3:], 'mm')}, turned by "
        f"{np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))):.2f} deg +- "
        f"{_sizes(np.degrees(sigma[:3]), 'deg')}"
    )
    if name in found.scales:
        text += f", scale {found.scales[name]:.5g}"
    if name in found.time_offset_sigmas_s:
        text += f", clock {1e3 * found.time_offsets_s[name]:+.1f} +- {1e3 * found.time_offset_sigmas_s[name]:.1f} ms"
    return text


def _sizes(sigma: np.ndarray, unit: str) -> str:
    return "(" + ", ".join(f"{x:.2g}" if np.isfinite(x) else "free" for x in sigma) + f") {unit}"


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.items()) or "none"
