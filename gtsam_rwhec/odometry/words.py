"""A calibration of odometries in words: the verdict, what to do, then the details."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gtsam_rwhec.odometry.calibrated import OdometryCalibration


def verdict(found: OdometryCalibration) -> str:
    """The first sentence: whether the poses are to be used."""
    if not found.certificate.is_optimal:
        return "Do not use these poses: no proof that they are the best was found."
    if found.free_directions:
        return (
            "Use these poses with care: the drive does not determine all of them. What is free is below; "
            "drive other turns (slopes, ramps), or give heights, the ground, a direction or a distance."
        )
    if found.others:
        return "Use these poses with care: another answer fits as well. Look which of them is yours."
    if found.findings:
        return "Use these poses with care: read the findings first."
    return "Use these poses."


def in_words(found: OdometryCalibration) -> str:
    """All of it."""
    lines = [verdict(found)]
    lines += [f"- free: {direction}" for direction in found.free_directions]
    lines += [f"- another answer: {other.why} (cost {other.cost_above:+.2g})" for other in found.others]
    lines += [f"- {finding}" for finding in found.findings]
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
