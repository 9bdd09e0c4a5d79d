"""The section of a rig file that says where a camera's intrinsics are, and how far they can be trusted."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BeforeValidator, Field, model_validator

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.unknown_intrinsics import Lens
from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.rig.field_types import OrText, Text, list_of
from gtsam_rwhec.rig.section import Section, one_of

#: The word for intrinsics that nobody states; a file of this name is {file: estimate}.
ESTIMATE = "estimate"


class Intrinsics(Section):
    """Where a camera's intrinsics are: a topic, a Kalibr camchain, another file, numbers in this section, or nowhere.

    `intrinsics: estimate` needs no calibration: they come from the images of a board, and are refined with the poses.
    """

    model_config = one_of(
        "topic", "kalibr", "file", "K", "estimate",
        together=(("width", "K"), ("height", "K"), ("model", "K"), ("D", "K")),
    )  # fmt: skip

    topic: Text | None = Field(
        default=None, description="a topic of CameraInfo or CameraCalibration", examples=["/cam_left/camera_info"]
    )
    kalibr: Text | None = Field(
        default=None, description="Kalibr's camchain: the same as file", examples=["camchain.yaml"]
    )
    camera: Text | None = Field(
        default=None,
        description="with a file of several cameras: the one; without it the one of the sensor's name",
        examples=["cam0"],
    )
    file: Text | None = Field(
        default=None,
        description="a file of Kalibr, COLMAP, ROS, OpenCV or plain numbers; intrinsics: FILE is the same in short",
        examples=["left.yaml"],
    )
    model: str | None = Field(
        default=None,
        description="with K: what D is: pinhole (no D), radtan (OpenCV, plumb_bob), equidistant (fisheye) or "
        "unified (omni, D is [xi, k1, k2, p1, p2])",
        examples=["radtan"],
    )
    width: int | None = Field(
        default=None, description="with K, in place of size", examples=[640], json_schema_extra={"unit": "pixels"}
    )
    height: int | None = Field(
        default=None, description="with K, in place of size", examples=[480], json_schema_extra={"unit": "pixels"}
    )
    size: Annotated[tuple[int, int], list_of(2, "[width, height] in pixels")] | None = Field(
        default=None,
        description="[width, height], with K or with a file that lacks it",
        examples=[[640, 480]],
        json_schema_extra={"unit": "pixels"},
    )
    K: Annotated[tuple[float, float, float, float], list_of(4, "[fx, fy, cx, cy] in pixels")] | None = Field(
        default=None,
        description="[fx, fy, cx, cy]; the middle of the first pixel is at 0, 0",
        examples=[[550.0, 550.0, 320.0, 240.0]],
        json_schema_extra={"unit": "pixels"},
    )
    D: tuple[float, ...] | None = Field(
        default=None, description="with model: coefficients in OpenCV's order", examples=[[-0.1, 0.02, 0.0, 0.0]]
    )
    estimate: Lens | None = Field(
        default=None,
        description="no calibration is there: from the images, with this lens model (any: the one that fits); "
        "intrinsics: estimate is {estimate: any} in short. It takes images of a board at different tilts",
        examples=["equidistant"],
    )
    stated: Literal["calibration", "nominal"] | None = Field(
        default=None,
        description="where they come from, however they are given: calibration (of this camera, with this lens and "
        "focus: right to 0.3 % of the focal length and 3 pixels of the centre) or nominal (a data sheet, a driver's "
        "default, another camera of the kind: right to 3 %, and to 30 pixels or 2 % of the width); nominal without it",
        examples=["calibration"],
    )

    @property
    def stated_as(self) -> Stated:
        """Where they come from: nominal unless the rig file says otherwise, unknown if they are to be estimated."""
        return "unknown" if self.estimate is not None else self.stated or "nominal"

    @model_validator(mode="after")
    def _is_one(self) -> Intrinsics:
        of_file = self.file is not None or self.kalibr is not None
        # A file of OpenCV may lack the size of the images.
        numbers = self._given("model", "width", "height", "K", "D", *([] if of_file else ["size"]))
        sources = self._given("topic", "kalibr", "file", "estimate") + (["numbers"] if numbers else [])
        if len(sources) != 1:
            raise ValueError(
                f"{' and '.join(sources) or 'nothing'} given; give one of topic, kalibr (with camera), file, numbers "
                "(K, size, and model and D with distortion), or estimate alone: the images say the rest"
            )
        if self.estimate is not None and self.stated is not None:
            raise ValueError(f"stated: {self.stated}, and they are to be estimated; leave stated or estimate out")
        if self.camera is not None and not of_file:
            raise ValueError("camera goes with a file: {file: camchain.yaml, camera: cam0}")
        if numbers:
            self.camera_of_numbers("these numbers")
        return self

    def camera_of_numbers(self, where: str) -> Camera:
        """The camera of size, K, model and D; `ValueError` if a number is missing or absurd."""
        if self.size is not None and self._given("width", "height"):
            raise ValueError("size has the width and the height already; leave width and height out")
        width, height = self.size or (self.width, self.height)
        if width is None or height is None or self.K is None:
            given = {"size: [width, height]": width is not None and height is not None, "K": self.K is not None}
            raise ValueError(f"{' and '.join(name for name, there in given.items() if not there)} missing")
        if self.model is None and self.D and any(self.D):
            raise ValueError("D without model; say which coefficients these are: model: radtan, equidistant or unified")
        fx, fy, cx, cy = self.K
        K = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
        return Camera.of(width, height, self.model or "pinhole", K, self.D or (), where)


def _as_section(given: Any) -> Any:
    """A section of intrinsics; text alone is a file, or the word estimate."""
    if given == ESTIMATE:
        return {"estimate": "any"}
    return {"file": given} if isinstance(given, str) else given


#: A section, or text alone: a file, or the word estimate.
IntrinsicsOrText: TypeAlias = Annotated[
    Intrinsics, BeforeValidator(_as_section), OrText("a file of intrinsics, or the word estimate")
]
