"""The motions of all sensors over common windows of time, and how their noise grows with the window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.sampling import SampledTrack


@dataclass(frozen=True)
class WindowMotions:
    """Motions of m sensors over n windows that follow one another: their errors are independent.

    Attributes
    ----------
    start, end : (n,) seconds
    M : (m, n, 4, 4) array
        T_before_after of each sensor, lengths as it measured them.
    used : (m, n) booleans
        Where a sensor has the window.
    length : (m, n) seconds
    first, second : (m, n, 3) and (m, n, 3, 3) arrays
        Integrals of p dt and p p' dt along the way, p in the frame at the window's end.
    by_offset : (m, n, 6) array
        Derivative of M (right perturbation) by the sensor's time offset, per second.
    """

    start: Array
    end: Array
    M: Array
    used: np.ndarray
    length: Array
    first: Array
    second: Array
    by_offset: Array

    @staticmethod
    def of(tracks: Sequence[SampledTrack], edges: Array, max_gap_s: float, *, clocks: bool = True) -> WindowMotions:
        """Between neighbouring times ``edges`` (n + 1,); windows that fewer than two sensors have are left out.

        Without ``clocks`` the derivatives by offsets are zero.
        """
        start, end = edges[:-1], edges[1:]
        used = np.array([track.covers(start, end, max_gap_s) for track in tracks])
        kept = used.sum(axis=0) >= 2
        start, end, used = start[kept], end[kept], used[:, kept]
        parts = [_of_track(track, start, end, clocks=clocks) for track in tracks]
        M, length, first, second, by_offset = (np.array(part) for part in zip(*parts, strict=True))
        M[~used] = np.eye(4)
        return WindowMotions(start, end, M, used, length, first, second, by_offset)

    @property
    def sensors(self) -> int:
        """How many sensors there are."""
        return len(self.M)

    def __len__(self) -> int:
        return len(self.start)

    def rotation_vectors(self) -> Array:
        """(m, n, 3) rotation vectors of the motions."""
        m, n = self.M.shape[:2]
        vectors: Array = se3.so3_logmap(self.M[:, :, :3, :3].reshape(m * n, 3, 3)).reshape(m, n, 3)
        return vectors

    def covariance_parts(self) -> tuple[Array, Array]:
        """Covariances (m, n, 6, 6) of M's right perturbation for a unit of rotation noise, and of translation noise.

        Each step's error e is carried to the window's end by Ad(T_end_step) = [R, 0; p^ R, R] (isotropic in e):
        so e_rotation gives [I, -p^; p^, -p^ p^] and e_translation [0, 0; 0, I], integrated over the window.
        """
        m, n = self.length.shape
        of_rotation, of_translation = np.zeros((m, n, 6, 6)), np.zeros((m, n, 6, 6))
        I3 = np.eye(3)
        by_length = self.length[:, :, None, None] * I3
        hats = se3.hat(self.first.reshape(-1, 3)).reshape(m, n, 3, 3)
        of_rotation[..., :3, :3] = by_length
        of_rotation[..., 3:, :3] = hats
        of_rotation[..., :3, 3:] = -hats
        # -p^ p^ = |p|^2 I - p p'
        of_rotation[..., 3:, 3:] = np.einsum("mnii->mn", self.second)[..., None, None] * I3 - self.second
        of_translation[..., 3:, 3:] = by_length
        return of_rotation, of_translation

    def selected(self, windows: np.ndarray) -> WindowMotions:
        """Some of the windows, by mask or numbers."""
        return WindowMotions(
            self.start[windows],
            self.end[windows],
            *(part[:, windows] for part in (self.M, self.used, self.length, self.first, self.second, self.by_offset)),
        )

    def without(self, left_out: np.ndarray) -> WindowMotions:
        """The same, with a sensor's windows (m, n) not used where ``left_out`` is true."""
        used = self.used & ~left_out
        return WindowMotions(
            self.start, self.end, self.M, used, self.length, self.first, self.second, self.by_offset
        ).selected(used.sum(axis=0) >= 2)


def _of_track(track: SampledTrack, start: Array, end: Array, *, clocks: bool) -> tuple[Array, ...]:
    T_start, T_end = track.poses(start), track.poses(end)
    M = se3.inverse(T_start) @ T_end
    length, first, second = track.path_sums(start, end, T_end)
    if not clocks:
        return M, length, first, second, np.zeros((len(start), 6))
    at_start = np.einsum("nij,nj->ni", se3.adjoint(se3.inverse(M)), track.velocities(start))
    # The sensor's stamp t is the reference's t + offset: a larger offset reads the track earlier.
    return M, length, first, second, at_start - track.velocities(end)
