"""Problems with the corners of observations."""

from __future__ import annotations

import gtsam_rwhec as rw


def problem_of(observations: rw.Observations, **options: object) -> rw.Problem:
    """A problem with all images of observations."""
    problem = rw.Problem(**options)  # type: ignore[arg-type]
    for (target, sensor), view in observations.views.items():
        problem.add_corners(
            target,
            sensor,
            view.A,
            view.pixels,
            observations.corners[target],
            observations.cameras[sensor],
            corner_px=observations.corner_px,
        )
    return problem
