"""One cloud of points, checked: what a 3D camera or a LiDAR saw at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from itertools import count

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CloudError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import real_array

#: The endings of files of one cloud; of images the depths.
CLOUD_FORMATS = (".pcd", ".ply", ".npy", ".npz", ".bin", ".png", ".tif", ".tiff")


@dataclass(frozen=True)
class Cloud:
    """Points of one sensor, in its frame.

    ``points`` (N, 3) are finite, in metres. ``at`` (N,) is the place of each in what was given: an organised image of
    ``shape`` (rows, columns) in its order, or the list of points. ``rings`` (N,) are a LiDAR's beams, ``times_s`` (N,)
    the seconds after ``stamp_ns``, ``intensities`` (N,) what it measured; each only where the sensor tells it.
    ``dropped`` points were nan, infinite, or at the origin: a sensor's ways to say that it saw nothing there.
    """

    points: Array
    at: np.ndarray
    shape: tuple[int, int] | None = None
    rings: np.ndarray | None = None
    times_s: Array | None = None
    intensities: Array | None = None
    stamp_ns: int | None = None
    frame_id: str = ""
    source: str = ""
    dropped: int = 0

    @staticmethod
    def of(
        points: ArrayLike,
        *,
        rings: np.ndarray | None = None,
        times_s: Array | None = None,
        intensities: Array | None = None,
        stamp_ns: int | None = None,
        frame_id: str = "",
        source: str = "",
    ) -> Cloud:
        """A cloud of points (N, 3), or of an organised image (rows, columns, 3), in metres.

        Raises
        ------
        CloudError
            The points cannot be read as three numbers each, none is left, or an array has another length.
        """
        where = source or frame_id or "the cloud"
        try:
            given = real_array(points)
        except ValueError as error:
            raise CloudError(f"{where}: points cannot be read as numbers ({error}); give (N, 3), metres") from error
        if given.ndim not in (2, 3) or given.shape[-1] != 3:
            raise CloudError(f"{where}: points have shape {given.shape}; give (N, 3) or (rows, columns, 3), metres")
        shape = (given.shape[0], given.shape[1]) if given.ndim == 3 else None
        flat = given.reshape(-1, 3)
        if not len(flat):
            raise CloudError(f"{where} has no points; look whether the sensor measured")
        seen = np.isfinite(flat).all(axis=1) & (flat != 0.0).any(axis=1)
        if not seen.any():
            raise CloudError(
                f"{where}: of {len(flat)} points none is seen (nan, infinite, or at the origin); look whether the "
                "sensor measured, and whether the fields x, y and z were read"
            )
        several = {"rings": rings, "times_s": times_s, "intensities": intensities}
        for name, values in several.items():
            if values is not None and np.shape(values) != (len(flat),):
                raise CloudError(f"{where}: {name} has shape {np.shape(values)} for {len(flat)} points")
        kept = {name: None if values is None else np.asarray(values)[seen] for name, values in several.items()}
        return Cloud(
            flat[seen],
            np.flatnonzero(seen),
            shape,
            **kept,
            stamp_ns=stamp_ns,
            frame_id=frame_id,
            source=source,
            dropped=int((~seen).sum()),
        )

    def __len__(self) -> int:
        return len(self.points)

    @staticmethod
    def each(given: Iterable[Cloud | ArrayLike]) -> Iterator[Cloud]:
        """The clouds that a caller gave; arrays of points (N, 3) are clouds too. A CloudError names what is none."""
        if isinstance(given, Cloud | str) or not isinstance(given, Iterable):
            raise CloudError(f"clouds are {brief(given)}; give a list of Cloud, one for each view")

        def named(number: int, one: Cloud | ArrayLike) -> Cloud:
            return one if isinstance(one, Cloud) else Cloud.of(one, source=f"clouds[{number}]")

        # Unlike a loop, a map does not hold a cloud until the next is read.
        yield from map(named, count(), given)

    def selected(self, mask: np.ndarray) -> Cloud:
        """The points where ``mask`` (N,) is true, or those at an array of places."""
        arrays = {part.name: getattr(self, part.name) for part in fields(self)}
        return replace(self, **{name: a[mask] for name, a in arrays.items() if isinstance(a, np.ndarray)})
