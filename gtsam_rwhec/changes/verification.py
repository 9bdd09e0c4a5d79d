"""Whether an old calibration still holds: the record, and its verdict in words."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.calibration.prediction_errors import PredictionError
from gtsam_rwhec.changes.change_test import ChangeTest
from gtsam_rwhec.changes.comparing import share_words
from gtsam_rwhec.changes.quantities import Movement
from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.files.terminal_text import shown

#: Why frames are not checked.
UNSEEN_SENSOR = "the new log has no measurement by it"
UNSEEN_TARGET = "the new log has no measurement of it"


@dataclass(frozen=True)
class SensorCheck:
    """How well the old poses predict what a sensor saw in the new log.

    Attributes
    ----------
    held : PredictionError
        Of the old poses: what a robot that uses them is off by, with the noise of the measurements.
    best : PredictionError or None
        Of the poses that fit the new log best: the noise of the measurements. None where none near the old ones fit.
    outliers : int
        Measurements that agree with no others; they count in neither.
    noise_ratio : float or None
        `best`'s root mean square translation over that of the old log's residuals; None where that has none.
    held_px : float or None
        Median distance of corners from where the old poses say that they are, pixels; None without images.
    """

    held: PredictionError
    best: PredictionError | None
    outliers: int
    noise_ratio: float | None
    held_px: float | None = None


@dataclass(frozen=True)
class Verification:
    """Whether an old calibration still holds; ``str()`` is the verdict.

    Attributes
    ----------
    test : ChangeTest or None
        Of the old poses against those that fit the new log best, by the sum of both covariances. None where the
        predictions are so far off that no test is needed, and none is possible.
    movements : dict of str to Movement
        From the old pose of each frame to the one that fits the new log best.
    sensors : dict of str to SensorCheck
    not_checked : dict of str to str
        Sensors and targets of the old calibration that the new log tells nothing of, with the reason.
    targets_may_move : bool
        Whether targets were left out of the test.
    remarks : tuple of str
    """

    test: ChangeTest | None
    movements: dict[str, Movement]
    sensors: dict[str, SensorCheck]
    not_checked: dict[str, str]
    targets_may_move: bool
    remarks: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing says that the old calibration no longer holds."""
        return self.test is not None and not self.test.has_changed

    @property
    def unchecked_sensors(self) -> tuple[str, ...]:
        """The sensors of the old calibration that were not checked."""
        return tuple(name for name, why in self.not_checked.items() if why == UNSEEN_SENSOR or name in self.sensors)

    def __str__(self) -> str:
        unchecked = ", ".join(map(shown, self.unchecked_sensors))
        but = f" Not checked: {unchecked}." if unchecked else ""
        if self.test is None:
            said = "; ".join(
                f"what {shown(name)} sees is {rounded(check.held.translation_median_mm)} mm and "
                f"{rounded(check.held.rotation_median_deg)} degrees off its predictions"
                for name, check in self.sensors.items()
            )
            return f"The calibration no longer holds: {said}. Check also that A and B are read as before.{but}"
        level = f"{100.0 * self.test.level:g} %"
        if self.holds:
            return (
                f"The calibration still holds at {level}: the new log agrees with it as well as by chance in "
                f"{share_words(self.test.chance)}.{but}"
            )
        named = self.test.changed
        if not named:
            return (
                f"The calibration no longer holds, by more than chance at {level}. No frame stands out by itself.{but}"
            )
        said = "; ".join(map(self.sentence, named))
        return f"The calibration no longer holds: {said}, more than chance at {level}.{but}"

    def sentence(self, name: str) -> str:
        """How far a frame seems to have moved, in words, without a full stop."""
        assert self.test is not None
        deviations = f"{self.test.groups[name].deviations:.1f} joint deviations"
        verb = "changed" if name in self.test.changed else "differs"
        if name not in self.movements:
            return f"{shown(name)} {verb}: {deviations}"
        moved = self.movements[name]
        verb = "moved" if name in self.test.changed else "differs by"
        by = f"{verb} {moved}"
        return f"{shown(name)} {by}: {deviations}"
