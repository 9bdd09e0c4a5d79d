"""Messages of every kind that the library reads: ROS 2, Foxglove as JSON and protobuf, other drivers."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest
from log_files import POSE, TRANSFORM, header, json_log, ros2_log, xyz
from read_logs import T0, T_EXPECTED, protobuf_log, read

from gtsam_rwhec.logs import DetectionRecord, ImageRecord, IntrinsicsRecord


def test_ros2_poses_of_every_kind(tmp_path: Path) -> None:
    covariance = np.diag([1.0, 4, 9, 0.01, 0.04, 0.09])
    with_covariance = {"pose": POSE, "covariance": covariance.ravel().tolist()}
    zero = {"twist": {"linear": xyz(0, 0, 0), "angular": xyz(0, 0, 0)}, "covariance": [0.0] * 36}
    stamped = {"header": header(T0, "/base"), "child_frame_id": "hand", "transform": TRANSFORM}
    other = {"header": header(T0 + 1, "hand"), "child_frame_id": "cam", "transform": TRANSFORM}
    odometry = {"header": header(T0), "child_frame_id": "b", "pose": with_covariance, "twist": zero}
    records = read(
        ros2_log(
            tmp_path / "a.mcap",
            [
                ("/a", "geometry_msgs/PoseStamped", {"header": header(T0 + 7), "pose": POSE}, T0),
                (
                    "/b",
                    "geometry_msgs/PoseWithCovarianceStamped",
                    {"header": header(T0), "pose": with_covariance},
                    T0 + 1,
                ),
                ("/c", "geometry_msgs/TransformStamped", stamped, T0 + 2),
                ("/tf_static", "tf2_msgs/TFMessage", {"transforms": [stamped, other]}, T0 + 3),
                ("/e", "nav_msgs/Odometry", odometry, T0 + 4),
            ],
        )
    )
    assert [(r.topic, r.parent, r.child) for r in records] == [
        ("/a", "world", ""), ("/b", "world", ""), ("/c", "base", "hand"), ("/tf_static", "base", "hand"),
        ("/tf_static", "hand", "cam"), ("/e", "world", "b"),
    ]  # fmt: skip
    for record in records:
        np.testing.assert_allclose(record.T, T_EXPECTED, atol=1e-15)
    assert (records[0].stamp_ns, records[0].logged_ns) == (T0 + 7, T0)
    assert [r.is_static for r in records] == [False] * 3 + [True] * 2 + [False]
    # A turn of 2 atan(0.75) about z: what is x in the world is seen along R' x in the body.
    R = T_EXPECTED[:3, :3]
    expected = np.zeros((6, 6))
    expected[:3, :3] = R.T @ np.diag([0.01, 0.04, 0.09]) @ R
    expected[3:, 3:] = R.T @ np.diag([1.0, 4, 9]) @ R
    for record in (records[1], records[5]):
        np.testing.assert_allclose(record.covariance, expected, atol=1e-15)
    assert records[0].covariance is None


@pytest.mark.parametrize("entry", [np.nan, np.inf, -1.0, 1.7e308])
def test_a_covariance_that_no_pose_has_is_unknown(tmp_path: Path, entry: float) -> None:
    covariance = np.diag([1.0, 4, 9, 0.01, 0.04, entry]).ravel().tolist()
    message = {"header": header(T0), "pose": {"pose": POSE, "covariance": covariance}}
    (record,) = read(ros2_log(tmp_path / "a.mcap", [("/a", "geometry_msgs/PoseWithCovarianceStamped", message, T0)]))
    assert record.covariance is None


def test_ros2_images_intrinsics_and_detections(tmp_path: Path) -> None:
    K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
    info = {
        "header": header(T0, "cam"), "height": 480, "width": 640, "distortion_model": "plumb_bob",
        "d": [0.1, 0.2, 0.0, 0.0, 0.3], "k": K, "r": np.eye(3).ravel().tolist(),
        "p": np.c_[np.reshape(K, (3, 3)), np.zeros(3)].ravel().tolist(), "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }  # fmt: skip
    image = {
        "header": header(T0, "cam"), "height": 2, "width": 3, "encoding": "mono8", "is_bigendian": 0, "step": 3,
        "data": b"abcdef",
    }  # fmt: skip
    tag = {
        "family": "36h11", "id": 7, "hamming": 0, "goodness": 0.0, "decision_margin": 50.0, "centre": xyz(1, 1),
        "corners": [xyz(0, 0), xyz(2, 0), xyz(2, 2), xyz(0, 2)], "homography": [0.0] * 9,
    }  # fmt: skip
    jpeg = {"header": header(T0, "cam"), "format": "jpeg", "data": b"\xff\xd8"}
    tags = {"header": header(T0, "cam"), "detections": [tag, {**tag, "id": 8}]}
    markers = {"header": header(T0, "cam"), "marker_ids": [3, 4], "poses": [POSE, POSE]}
    info_, image_, jpeg_, seven, eight, three, four = read(
        ros2_log(
            tmp_path / "a.mcap",
            [
                ("/info", "sensor_msgs/CameraInfo", info, T0),
                ("/image", "sensor_msgs/Image", image, T0 + 1),
                ("/jpeg", "sensor_msgs/CompressedImage", jpeg, T0 + 2),
                ("/tags", "apriltag_msgs/AprilTagDetectionArray", tags, T0 + 3),
                ("/markers", "ros2_aruco_interfaces/ArucoMarkers", markers, T0 + 4),
            ],
        )
    )
    assert isinstance(info_, IntrinsicsRecord)
    np.testing.assert_array_equal(info_.K, np.reshape(K, (3, 3)))
    assert (info_.width, info_.height, info_.model, info_.D.tolist()) == (640, 480, "plumb_bob", info["d"])
    assert isinstance(image_, ImageRecord)
    assert (image_.data, image_.width, image_.height, image_.is_compressed) == (b"abcdef", 3, 2, False)
    assert (jpeg_.encoding, jpeg_.data, jpeg_.is_compressed) == ("jpeg", b"\xff\xd8", True)
    assert isinstance(seven, DetectionRecord)
    assert (seven.family, seven.id, eight.id, three.id, four.id) == ("36h11", "7", "8", "3", "4")
    np.testing.assert_array_equal(seven.corners_px, [[0, 0], [2, 0], [2, 2], [0, 2]])
    np.testing.assert_allclose(four.T_camera_tag, T_EXPECTED, atol=1e-15)


def test_detections_of_other_drivers(tmp_path: Path) -> None:
    covariance = np.diag([0.01, 0.01, 0.04, 1e-4, 1e-4, 9e-4]).ravel().tolist()
    pose = {"pose": POSE, "covariance": covariance}
    isaac = {
        "family": "tag36h11", "id": 5, "center": xyz(1, 1, 0), "corners": [xyz(i, i, 0) for i in range(4)],
        "pose": {"header": header(T0, "cam"), "pose": pose},
    }  # fmt: skip
    marker = {"header": header(T0, "cam"), "id": 9, "pose": pose, "confidence": 1.0}
    opencv = {
        "header": header(T0, "cam"),
        "markers": [{"marker_id": 2, "pose": POSE}],
        "boards": [{"board_name": "lid", "pose": POSE}],
    }
    records = read(
        ros2_log(
            tmp_path / "a.mcap",
            [
                (
                    "/isaac",
                    "isaac_ros_apriltag_interfaces/AprilTagDetectionArray",
                    {"header": header(T0, "cam"), "detections": [isaac]},
                    T0,
                ),
                ("/aruco", "aruco_msgs/MarkerArray", {"header": header(T0, "cam"), "markers": [marker]}, T0 + 1),
                ("/opencv", "aruco_opencv_msgs/ArucoDetection", opencv, T0 + 2),
            ],
        )
    )
    assert [(r.topic, r.family, r.id, r.frame) for r in records] == [
        ("/isaac", "tag36h11", "5", "cam"),
        ("/aruco", "", "9", "cam"),
        ("/opencv", "", "2", "cam"),
        ("/opencv", "", "lid", "cam"),
    ]
    for record in records:
        np.testing.assert_allclose(record.T_camera_tag, T_EXPECTED, atol=1e-15)
    np.testing.assert_array_equal(records[0].corners_px, [[i, i] for i in range(4)])
    for record in records[:2]:  # ROS has translation first, along fixed axes; turned by 73.74 degrees about z
        assert record.covariance is not None
        np.testing.assert_allclose(np.diagonal(record.covariance), [1e-4, 1e-4, 9e-4, 0.01, 0.01, 0.04], atol=1e-12)


def test_foxglove_json(tmp_path: Path) -> None:
    time = {"sec": T0 // 10**9, "nsec": 5}
    transform = {"timestamp": time, "parent_frame_id": "base", "child_frame_id": "hand", **TRANSFORM}
    pixels = base64.b64encode(b"abcdef").decode()
    raw = {"timestamp": time, "frame_id": "c", "width": 3, "height": 2, "encoding": "mono8", "step": 3, "data": pixels}
    calibration = {
        "timestamp": time, "frame_id": "c", "width": 4, "height": 3, "distortion_model": "kannala_brandt",
        "D": [0, 0, 0, 0], "K": [1, 0, 2, 0, 1, 2, 0, 0, 1], "R": [], "P": [],
    }  # fmt: skip
    records = read(
        json_log(
            tmp_path / "a.mcap",
            [
                ("/a", "foxglove.FrameTransform", transform, 1),
                ("/b", "foxglove.FrameTransforms", {"transforms": [transform, transform]}, 2),
                ("/c", "foxglove.PoseInFrame", {"timestamp": time, "frame_id": "base", "pose": POSE}, 3),
                ("/d", "foxglove.PosesInFrame", {"timestamp": time, "frame_id": "base", "poses": [POSE, POSE]}, 4),
                ("/e", "foxglove.RawImage", raw, 5),
                (
                    "/f", "foxglove.CompressedImage",
                    {"timestamp": time, "frame_id": "c", "format": "png", "data": pixels}, 6,
                ),
                ("/g", "foxglove.CameraCalibration", calibration, 7),
            ],
        )
    )  # fmt: skip
    assert [r.topic for r in records] == ["/a", "/b", "/b", "/c", "/d", "/d", "/e", "/f", "/g"]
    for record in records[:6]:
        np.testing.assert_allclose(record.T, T_EXPECTED, atol=1e-15)
        assert (record.parent, record.stamp_ns) == ("base", T0 + 5)
    assert (records[6].data, records[7].data, records[8].model) == (b"abcdef", b"abcdef", "kannala_brandt")
    np.testing.assert_array_equal(records[8].P, [[1, 0, 2, 0], [0, 1, 2, 0], [0, 0, 1, 0]])


def test_foxglove_protobuf(tmp_path: Path) -> None:
    (record,) = read(protobuf_log(tmp_path / "a.mcap"))
    np.testing.assert_allclose(record.T, T_EXPECTED, atol=1e-15)
    assert (record.parent, record.child, record.stamp_ns) == ("base", "hand", T0 + 5)
