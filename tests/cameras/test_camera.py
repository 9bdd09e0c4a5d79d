"""Projection against OpenCV, derivatives against finite differences, undistortion, and wrong intrinsics."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError

K = np.array([[420.0, 0.0, 322.5], [0.0, 431.0, 236.0], [0.0, 0.0, 1.0]])
#: Ordinary lenses of each model.
LENSES = {
    "none": ("pinhole", ()),
    "four": ("plumb_bob", (-0.28, 0.09, 0.0008, -0.0005)),
    "five": ("plumb_bob", (-0.31, 0.14, -0.001, 0.0012, -0.03)),
    "eight": ("rational_polynomial", (0.5, 0.2, 0.001, -0.0007, 0.01, 0.85, 0.31, 0.05)),
    "twelve": ("rational_polynomial", (0.4, 0.1, 1e-3, -7e-4, 0.01, 0.75, 0.2, 0.03, 2e-3, -1e-3, 1e-3, 5e-4)),
    "pincushion": ("plumb_bob", (0.11, 0.04, -0.0006, 0.0004)),
    "fisheye": ("equidistant", (-0.02, 0.006, -0.004, 0.0008)),
    "wide fisheye": ("fisheye", (0.06, -0.01, 0.002, -0.0003)),
    "unified": ("unified", (0.6, -0.1, 0.05, 1e-3, -5e-4)),
}
EVERY = pytest.mark.parametrize("lens", LENSES)


def camera_of(lens: str) -> Camera:
    model, D = LENSES[lens]
    return Camera.of(640, 480, model, K, D, "test")


def coefficients(count: int) -> st.SearchStrategy[np.ndarray]:
    number = st.floats(-0.3, 0.3, allow_subnormal=False)
    return st.lists(number, min_size=count, max_size=count).map(np.array)


POINTS = st.lists(
    st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(0.8, 5.0)), min_size=1, max_size=5
).map(lambda rows: np.array(rows, dtype=float))


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([4, 5, 8, 12]).flatmap(coefficients), POINTS)
def test_radtan_projects_as_opencv_does(D: np.ndarray, points: np.ndarray) -> None:
    camera = Camera.of(640, 480, "plumb_bob" if len(D) < 8 else "rational_polynomial", K, D, "test")
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)
    found = camera.pixels(points[:, :2] / points[:, 2:])
    # Random rational coefficients have poles, near which all digits go.
    size = 1.0 + np.abs(expected).max()
    if size < 1e7:
        np.testing.assert_allclose(found, expected[:, 0], atol=1e-9 * size)


@settings(max_examples=80, deadline=None)
@given(coefficients(4), POINTS)
def test_equidistant_projects_as_opencv_does(D: np.ndarray, points: np.ndarray) -> None:
    camera = Camera.of(640, 480, "equidistant", K, D, "test")
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, D)
    np.testing.assert_allclose(camera.pixels(points[:, :2] / points[:, 2:]), expected[:, 0], atol=1e-7)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([4, 5, 8]).flatmap(coefficients), st.booleans())
@example(np.array([0.1875, 0.0, 0.0, 0.0, -0.26078869, 0.24708576, -0.29433361, -0.11132812]), False)
def test_the_distorted_radius_is_largest_at_the_ring(D: np.ndarray, is_fisheye: bool) -> None:
    D = D[:4] if is_fisheye else np.concatenate([D[:2], [0.0, 0.0], D[4:]])
    camera = Camera.of(640, 480, "equidistant" if is_fisheye else "rational_polynomial", K, D, "test")
    furthest = 30.0 if is_fisheye else 5.0
    r = np.linspace(0.0, min(furthest, 0.999 * camera.ring), 3001)
    assert (camera.pixel_jacobian(np.stack([r, np.zeros_like(r)], axis=1))[1][:, 0, 0] > 0.0).all()
    if len(D) == 8 and np.isfinite(camera.ring):
        # A pole next to a root of the numerator is hardly one: whoever has such coefficients loses what is beyond it.
        assume(abs(np.polyval([*D[[4, 1, 0]], 1.0], camera.ring**2)) > 1e-2)
    if camera.ring < furthest:  # at once beyond it
        beyond = np.array([[camera.ring * 1.0001, 0.0]])
        slope = camera.pixel_jacobian(beyond)[1][0, 0, 0]
        assert slope < 1e-6 or slope > 1e6 or np.abs(camera.pixels(beyond)).max() > 1e4  # the last two: at a pole
        points = np.array([[0.999 * camera.ring, 0.0, 1.0], [1.001 * camera.ring, 0.0, 1.0]])
        assert np.isnan(camera.project(points)).any(axis=1).tolist() == [False, True]


@EVERY
def test_derivatives_agree_with_finite_differences(lens: str) -> None:
    camera, h = camera_of(lens), 1e-6
    random = np.random.default_rng(0).uniform(-0.8, 0.8, (40, 2))
    near_the_axis = np.random.default_rng(1).normal(size=(20, 2)) * np.repeat(10.0 ** -np.arange(3, 8), 4)[:, None]
    x = np.concatenate([random, near_the_axis, np.zeros((1, 2)), [[0.3, 0.0], [0.0, -0.4]]])
    pixels, J = camera.pixel_jacobian(x)
    np.testing.assert_allclose(pixels, camera.pixels(x))
    for k, step in enumerate(h * np.eye(2)):
        numeric = (camera.pixels(x + step) - camera.pixels(x - step)) / (2 * h)
        np.testing.assert_allclose(J[..., k], numeric, atol=2e-6 * 431)


@EVERY
def test_undistort_is_the_inverse_of_pixels(lens: str) -> None:
    camera = camera_of(lens)
    u, v = np.meshgrid(np.linspace(-0.5, 639.5, 33), np.linspace(-0.5, 479.5, 25))
    pixels = np.stack([u, v], axis=-1)
    x = camera.undistort(pixels)
    assert np.isfinite(x).all()
    np.testing.assert_allclose(camera.pixels(x), pixels, atol=1e-5)
    again = camera.undistort(camera.pixels(0.9 * x))
    np.testing.assert_allclose(again, 0.9 * x, atol=1e-8)


def test_a_fisheye_sees_nearly_to_the_side() -> None:
    wide = [[200.0, 0.0, 320.0], [0.0, 200.0, 240.0], [0.0, 0.0, 1.0]]
    camera = Camera.of(640, 480, "equidistant", wide, (0.1, 0.0, 0.0, 0.0), "test")
    theta = np.radians([60.0, 75.0, 85.0])
    x = np.tan(theta)[:, None] * np.array([0.6, 0.8])
    np.testing.assert_allclose(camera.undistort(camera.pixels(x)), x, rtol=1e-8)


@pytest.mark.parametrize(("xi", "k1"), [(-0.5, 0.0), (1e-9, 0.0), (0.8, 0.0), (1.0, -0.1), (2.5, -0.2)])
def test_a_unified_camera_sees_points_on_the_unit_sphere_from_behind_its_middle(xi: float, k1: float) -> None:
    camera = Camera.of(640, 480, "unified", K, (xi, k1), "test")
    furthest = np.arctan(min(camera.ring, 1e6))
    assert furthest == pytest.approx(np.pi / 3 if xi < 0.0 else furthest)  # its pole: cos(theta) = -xi
    theta = np.linspace(0.0, 0.98 * furthest, 30)
    rays = np.stack([0.6 * np.sin(theta), 0.8 * np.sin(theta), np.cos(theta)], axis=1)
    m = rays[:, :2] / (rays[:, 2:] + xi)
    bent = m * (1.0 + k1 * np.einsum("ni,ni->n", m, m))[:, None]
    pixels = bent * [420.0, 431.0] + [322.5, 236.0]
    np.testing.assert_allclose(camera.project(3.0 * rays), pixels, atol=1e-5)
    np.testing.assert_allclose(camera.undistort(pixels), rays[:, :2] / rays[:, 2:], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(("xi", "k1"), [(1.0, 0.0), (1.0, -0.6), (2.5, 0.0), (-0.5, -0.1)])
def test_a_unified_camera_has_rays_in_front_and_within_its_ring_only(xi: float, k1: float) -> None:
    camera = Camera.of(640, 480, "unified", K, (xi, k1), "test")
    m = np.sqrt(1.0 / (3.0 * -k1)) if k1 < 0.0 else np.inf  # where m (1 + k1 m^2) is largest
    last = min(m, 1.0 / xi) if xi > 0.0 else m  # at 1 / xi rays are square to the axis
    furthest = 420.0 * last * (1.0 + k1 * last**2)
    found = camera.undistort(np.array([[322.5 + share * furthest, 236.0] for share in (0.9, 0.999, 1.001, 1.5, 5.0)]))
    assert np.isfinite(found).all(axis=1).tolist() == [True, True, False, False, False]
    assert camera.focal_px == pytest.approx(425.5 / (1.0 + xi))


def test_behind_the_camera_nothing_is_seen() -> None:
    points = np.array([[0.1, 0.2, 1.0], [0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.0]])
    for lens in LENSES:
        pixels = camera_of(lens).project(points)
        assert np.isfinite(pixels).all(axis=1).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("model", "D", "ring"),
    [("plumb_bob", (-0.28, 0.0, 0.0, 0.0), np.sqrt(1.0 / (3 * 0.28))), ("equidistant", (-0.2, 0.0, 0.0, 0.0), None)],
)
def test_no_ray_leads_beyond_the_ring(model: str, D: tuple[float], ring: float) -> None:
    camera = Camera.of(640, 480, model, K, D, "test")
    if ring is None:  # theta (1 - 0.2 theta^2) is largest where 0.6 theta^2 = 1
        theta = np.sqrt(1.0 / 0.6)
        furthest, ring = theta * (1.0 - 0.2 * theta**2), np.tan(theta)
    else:
        furthest = ring * (1.0 - 0.28 * ring**2)
    directions = np.stack([np.cos(np.arange(12.0)), np.sin(np.arange(12.0))], axis=1)
    for share in (0.5, 0.9, 0.99):
        x = camera.undistort(camera.pixels(share * ring * directions))
        np.testing.assert_allclose(x, share * ring * directions, atol=1e-7)
    for share in (1.01, 1.1, 1.5, 2.0, 3.0, 5.0, 10.0, 100.0):
        pixels = share * furthest * directions * np.diagonal(K)[:2] + K[:2, 2]
        assert np.isnan(camera.undistort(pixels)).all(), share


def test_the_share_of_the_image_beyond_the_fold() -> None:
    folded = Camera.of(640, 480, "plumb_bob", K, (-0.9, 0.0, 0.0, 0.0), "test")
    radius = np.sqrt(1.0 / 2.7) * 2.0 / 3.0
    assert folded.reach_px == pytest.approx(420.0 * radius, rel=1e-6)
    ellipse = np.pi * radius**2 * 420.0 * 431.0 / (640 * 480)  # wholly inside the image
    assert folded.share_beyond_fold == pytest.approx(1.0 - ellipse, abs=0.03)
    assert camera_of("four").share_beyond_fold == camera_of("wide fisheye").share_beyond_fold == 0.0


def test_a_pixel_without_a_ray_does_not_change_the_others() -> None:
    camera = Camera.of(640, 480, "plumb_bob", K, (-0.28, 0.0, 0.0, 0.0), "test")
    x = np.array([[0.1, 0.2], [0.3, -0.1]])
    pixels = np.concatenate([camera.pixels(x), [[5000.0, 5000.0], [np.nan, 3.0]]])
    back = camera.undistort(pixels)
    np.testing.assert_allclose(back[:2], x, atol=1e-9)
    assert np.isnan(back[2:]).all()


def test_inside_goes_to_the_pixels_outer_edges() -> None:
    camera = camera_of("none")
    pixels = np.array([[-0.5, -0.5], [639.5, 479.5], [-0.6, 0.0], [640.0, 0.0], [0.0, 480.0], [np.nan, 1.0]])
    assert camera.inside(pixels).tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize(
    ("word", "model"),
    [
        ("plumb_bob", "radtan"),
        ("Rational_Polynomial", "radtan"),
        ("radtan", "radtan"),
        ("kannala_brandt", "equidistant"),
        ("fisheye", "equidistant"),
        (" equidistant ", "equidistant"),
    ],
)
def test_models_have_the_words_of_ros_foxglove_and_kalibr(word: str, model: str) -> None:
    assert Camera.of(640, 480, word, K, (0.1, 0.02, 0.0, 0.0), "test").model == model


def test_zeros_are_no_distortion() -> None:
    for word in ("", "none", "pinhole", "plumb_bob", "rational_polynomial"):
        camera = Camera.of(640, 480, word, K, np.zeros(14), "test")
        assert (camera.model, camera.D.tolist()) == ("pinhole", [])
    fisheye = Camera.of(640, 480, "equidistant", K, (), "test")  # no coefficients are still no pinhole
    assert (fisheye.model, fisheye.D.tolist()) == ("equidistant", [0.0] * 4)


def test_trailing_zeros_are_left_out() -> None:
    assert Camera.of(640, 480, "plumb_bob", K, [0.1, 0.0, 0.0, 0.0, 0.0], "test").D.tolist() == [0.1, 0, 0, 0]
    assert len(Camera.of(640, 480, "rational_polynomial", K, [0.1, 0, 0, 0, 0, 0.2, *[0] * 8], "test").D) == 8


def changed(row: int, column: int, value: float) -> np.ndarray:
    other = K.copy()
    other[row, column] = value
    return other


@pytest.mark.parametrize(
    ("size", "model", "matrix", "D", "words"),
    [
        ((640, 480), "plumb_bob", np.zeros((3, 3)), (), "not calibrated"),
        ((640, 480), "plumb_bob", changed(0, 0, np.nan), (), "finite 3 x 3"),
        ((640, 480), "plumb_bob", np.eye(2), (), "finite 3 x 3"),
        ((640, 480), "plumb_bob", changed(0, 1, 0.5), (), "must be"),
        ((640, 480), "plumb_bob", changed(2, 2, 0.0), (), "must be"),
        ((640, 480), "plumb_bob", changed(0, 0, -420.0), (), "fx = -420"),
        ((640, 480), "plumb_bob", changed(1, 1, 0.0036), (), "fy = 0.0036 .* is the unit pixels"),
        ((640, 480), "plumb_bob", changed(0, 0, 1e6), (), r"fx = 1e\+06"),
        ((640, 480), "plumb_bob", changed(0, 2, 2000.0), (), "cx = 2000"),
        ((640, 480), "plumb_bob", changed(1, 2, -600.0), (), "cy = -600"),
        ((0, 480), "plumb_bob", K, (), "0 x 480"),
        ((640, -1), "plumb_bob", K, (), "640 x -1"),
        ((10**6, 10**6), "plumb_bob", K, (), "1000000 x 1000000"),
        ((640, 480), "plumb_bob", K, (0.1, np.inf, 0.0, 0.0), "distortion coefficients"),
        ((640, 480), "plumb_bob", K, (1e5, 0.0, 0.0, 0.0), "distortion coefficients"),
        ((640, 480), "omnidirectional", K, (0.1, 0.0, 0.0, 0.0), "'omnidirectional' is not supported.*'plumb_bob'"),
        ((640, 480), "rational_polynomial", K, (*[0.01] * 12, 0.02, 0.0), "tilted sensor"),
        ((640, 480), "equidistant", K, (0.01, 0.0, 0.0, 0.0, 0.02), "5 coefficients are too many"),
        ((640, 480), "unified", K, (), "needs xi, the first of D"),
        ((640, 480), "unified", K, (-2.0, 0.1), "xi = -2, the first of D, must be between"),
        ((640, 480), "unified", K, (1.0, *[0.01] * 5), "6 coefficients are too many for the model unified"),
        ((640, 480), "", K, (0.1, 0.0, 0.0, 0.0), "without a distortion model"),
        ((640, 480), "pinhole", K, (0.1, 0.0, 0.0, 0.0), "without a distortion model"),
    ],
)  # fmt: skip
def test_wrong_intrinsics_are_refused(
    size: tuple[int, int], model: str, matrix: np.ndarray, D: tuple[float, ...], words: str
) -> None:
    with pytest.raises(CameraError, match=rf"^/cam/info: .*{words}"):
        Camera.of(*size, model, matrix, D, "/cam/info")
