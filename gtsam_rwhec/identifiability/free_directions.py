"""Free directions in words: which frame, which axis, and why."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: A frame's share of a direction below this (of the largest share, radians weighed by a typical length) goes unsaid.
SHARE = 0.05
#: An axis within this angle of a coordinate axis is called by its name.
AXIS_COSINE = np.cos(np.radians(8.0))

#: A motion that turned by this much (rms) and is still lost in the noise did turn: it is the residuals that are large.
TURNED_RAD = np.radians(3.0)


def reason_for(axes: int, turned_rad: float, residual_rad: float) -> str:
    """Why something of a pair is free, in words.

    Parameters
    ----------
    axes : int
        About how many axes its motion turned, beyond the noise: 0, 1, or 2 for two and more.
    turned_rad : float
        Root mean square of its turning, noise or not.
    residual_rad : float
        Root mean square of its rotation residuals.
    """
    if axes < 2 and turned_rad > TURNED_RAD and residual_rad > 0.5 * turned_rad:
        return (
            f"the residuals ({np.degrees(residual_rad):.0f} deg) are as large as the motion: is A or B inverted, "
            "is the quaternions' order right?"
        )
    if axes == 0:
        return "the motion did not turn"
    if axes == 1:
        return "the motion turned about one axis only"
    return "the measurements say no more about it than their noise would"


def describe(
    names: tuple[str, ...], basis: Array, length_m: float, reasons: dict[str, str], scale_mode: str
) -> list[str]:
    """One sentence for each frame, and for each scale, that the directions move.

    Parameters
    ----------
    names : tuple of str
        Frames.
    basis : (7 n + 1, k) array
        Free directions: [omega (rad), v (m), log own scale] for each frame, then the shared scale's logarithm.
    length_m : float
        How many metres count as much as a radian.
    reasons : dict of str to str
        Why, for each frame (``reason_for``).
    scale_mode : str
    """
    n = len(names)
    metric = np.r_[np.tile(np.r_[np.full(3, length_m), np.ones(3), length_m], n), length_m]
    weighed, _ = np.linalg.qr(basis * metric[:, None])
    frames = weighed[:-1].reshape(n, 7, basis.shape[1])
    # Directions that turn nothing come apart from those that do: the right singular vectors of the rotations' rows.
    turning = frames[:, :3].reshape(3 * n, basis.shape[1])
    _, s, Vt = np.linalg.svd(turning, full_matrices=True)
    turns = np.zeros(len(Vt), dtype=bool)
    turns[: len(s)] = s > SHARE
    still, turned = weighed @ Vt[~turns].T, weighed @ Vt[turns].T
    sentences = []
    for i, name in enumerate(names):
        rows = slice(7 * i, 7 * i + 7)
        words = []
        axis = _axes(turned[rows][:3])
        if axis:
            moves = bool(np.linalg.norm(turned[rows][3:6]) > SHARE)
            words.append(f"rotation about {axis}" + (" (its translation moves along)" if moves else ""))
        axis = _axes(still[rows][3:6])
        if axis:
            words.append(f"translation along {axis}")
        own = bool(np.abs(weighed[rows][6]).max(initial=0.0) > SHARE)
        if own:
            words.append("its scale")
        if words:
            of_frame = " of its own frame" if axis or "rotation" in words[0] else ""
            sentences.append(f"{name}: {' and '.join(words)}{of_frame}; {reasons[name]}")
    if scale_mode == "shared" and np.abs(weighed[-1]).max(initial=0.0) > SHARE:
        sentences.append("scale: a change of it is made up for by the frames' translations on these motions")
    if not sentences:
        sentences.append("a combination of small changes of all frames; the measurements are hardly more than noise")
    return sentences


def _axes(block: Array) -> str:
    """Words for the span of a (3, k) block's columns: "z", "x and y", "(0.60, 0.80, 0.00)", "every axis"; or ""."""
    if block.shape[1] == 0:
        return ""
    U, s, _ = np.linalg.svd(block)
    rank = int((s > SHARE).sum())
    if rank == 0:
        return ""
    if rank == 3:
        return "every axis"
    if rank == 2:
        normal = U[:, 2]
        k = int(np.abs(normal).argmax())
        if abs(normal[k]) > AXIS_COSINE:
            return " and ".join("xyz"[i] for i in range(3) if i != k)
        return f"every axis but {_vector(normal)}"
    direction = U[:, 0]
    k = int(np.abs(direction).argmax())
    return "xyz"[k] if abs(direction[k]) > AXIS_COSINE else _vector(direction)


def _vector(direction: Array) -> str:
    direction = direction * np.sign(direction[np.abs(direction).argmax()])
    return "(" + ", ".join(f"{x + 0.0:.2f}" for x in np.round(direction, 2)) + ")"
