"""What was seen: detections over time, what was removed and why, corners in the images, and the worst images."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from gtsam_rwhec.evidence.record import EvidenceRecord, Row

#: An image's longer side has so many cells, and its shorter side so many, for the share that has corners.
CELLS = (8, 6)
#: Time is divided into so many pieces: a figure has no more pixels.
PIECES = 400
#: So many rows of detections over time; with more pairs there is one row a sensor.
MOST_ROWS = 24
#: So many removed measurements are listed.
MOST_LISTED = 200
#: So many images whose corners are farthest off are shown.
MOST_WORST = 6


class SeenTrack(EvidenceRecord):
    """Measurements of a pair, or of all targets by a sensor, over time."""

    sensor: str = Field(description="the sensor's name")
    target: str | None = Field(description="the target's name; null: all targets together")
    used: int = Field(description="measurements in the answer", ge=0)
    removed: int = Field(description="measurements that are not", ge=0)
    used_at: tuple[tuple[int, int], ...] = Field(
        description="pieces of time with measurements in the answer, and how many"
    )
    removed_at: dict[str, tuple[tuple[int, int], ...]] = Field(description="the same of removed measurements, by stage")


class RemovedCount(EvidenceRecord):
    """How many measurements of a pair were removed for a reason."""

    target: str = Field(description="the target's name")
    sensor: str = Field(description="the sensor's name")
    stage: str = Field(description="which stage removed them")
    reason: str = Field(description="why")
    count: int = Field(description="how many", gt=0)


class RemovedMeasurement(EvidenceRecord):
    """A measurement that was removed."""

    target: str = Field(description="the target's name")
    sensor: str = Field(description="the sensor's name")
    reason: str = Field(description="why")
    image: str = Field(description="name of the image's file; else its stamp in nanoseconds, or its place in the pair")
    time_s: float | None = Field(description="since the first measurement; null without stamps")


class SeenCamera(EvidenceRecord):
    """Where a camera saw corners, in the images that are used."""

    sensor: str = Field(description="the sensor's name")
    width: int = Field(description="pixels", gt=0)
    height: int = Field(description="pixels", gt=0)
    images: int = Field(description="images with corners, once for each target", ge=0)
    corners: int = Field(description="corners in them", ge=0)
    cells: tuple[tuple[int, ...], ...] = Field(description="corners in each cell of the image, rows from the top")
    share: float = Field(description="share of the cells that have a corner")
    rms_px: float = Field(description="root mean square of dx and dy over all corners that count")
    noise_px: float | None = Field(description="deviation of a corner along each axis, as it counted")
    at_optimum: bool = Field(
        description="true: the carriers' pose of each image as its corners and the pose's noise together say; false: "
        "the pose as measured"
    )
    x: Row = Field(description="some of the corners, spread over all images: pixels from the left")
    y: Row = Field(description="pixels from the top")
    dx: Row = Field(description="seen minus predicted, pixels")
    dy: Row = Field(description="seen minus predicted, pixels")


class WorstImage(EvidenceRecord):
    """An image whose corners are far off under the answer."""

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    target: str = Field(description="the target's name")
    sensor: str = Field(description="the sensor's name")
    image: str = Field(description="name of the image's file; else its stamp in nanoseconds, or its place in the pair")
    is_used: bool = Field(description="whether it is in the answer")
    corners: int = Field(description="corners in it", gt=0)
    rms_px: float = Field(description="root mean square of its corners' errors along each axis, pixels")
    largest_px: float = Field(description="length of the largest error, pixels")
    times_noise: float | None = Field(description="rms over the deviation of a corner")
    magnified: float = Field(default=1.0, description="errors are drawn so many times as long")
    picture: bytes | None = Field(default=None, description="the target in it, JPEG, base64; null where there is none")


class SeenEvidence(EvidenceRecord):
    """What was seen."""

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    span_s: float | None = Field(description="from the first measurement to the last; null: no stamps")
    pieces: int = Field(description="pieces that the time, or without stamps the order, is divided into", gt=0)
    tracks: tuple[SeenTrack, ...] = Field(description="a row each of the figure over time")
    used: int = Field(description="measurements in the answer", ge=0)
    removed: int = Field(description="measurements that are not", ge=0)
    removed_counts: tuple[RemovedCount, ...] = Field(description="all that was removed, by pair, stage and reason")
    removed_list: tuple[RemovedMeasurement, ...] = Field(description="the first that were removed")
    cameras: tuple[SeenCamera, ...] = Field(default=(), description="cameras with corners")
    worst: tuple[WorstImage, ...] = Field(default=(), description="images whose corners are farthest off, worst first")
    sheet: bytes | None = Field(default=None, description="contact sheet, JPEG, base64")
    no_pictures: str = Field(default="", description="why there are no images; empty where there are some")
