import numpy as np
import pytest

from softwarp.render.camera import Camera, box_corners, horizontal_axes, workspace


def project(camera, points, aspect):
    """Picture coordinates in [-1, 1] of points, and their depth [m]."""
    right, upwards, forward = camera.basis()
    offset = np.asarray(points) - camera.eye
    depth = offset @ forward
    tan = np.tan(np.radians(camera.fov) / 2)
    return np.stack([offset @ right / (depth * tan * aspect), offset @ upwards / (depth * tan)], axis=-1), depth


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1)])
@pytest.mark.parametrize("aspect", [0.5, 4 / 3, 3.0])
def test_camera_sees_the_box_and_fills_the_picture(up, aspect):
    """All corners are in the picture, in front of the eye, and the tighter direction is filled to 8 % and centred."""
    corners = box_corners([[-0.1, 0.2, 0.0], [0.3, 0.5, 0.9]])
    at, depth = project(Camera.seeing(corners, up, aspect=aspect), corners, aspect)
    assert np.all(depth > 0.0)
    assert 0.88 < np.abs(at).max() <= 0.93
    np.testing.assert_allclose(at.max(axis=0), -at.min(axis=0), atol=0.02)


def test_up_is_up_in_the_picture():
    camera = Camera.seeing(box_corners([[0, 0, 0], [1, 1, 1]]), (0, 1, 0))
    at, _ = project(camera, [[0.5, 0.2, 0.5], [0.5, 0.8, 0.5]], 1.0)
    assert at[1, 1] > at[0, 1]
    assert at[1, 0] == pytest.approx(at[0, 0], abs=0.05)


def test_horizontal_axes_are_right_handed():
    for up in np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0.0, 0.8]]]):
        side, depth = horizontal_axes(up)
        np.testing.assert_allclose(np.linalg.det([side, depth, up]), 1.0)
    np.testing.assert_array_equal(horizontal_axes((0, 0, 1)), [[1, 0, 0], [0, 1, 0]])


def test_workspace_holds_the_half_ball_of_a_clamped_beam():
    """A beam along +z from a fixed end: its reach to both sides, nothing behind its root."""
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])
    points = workspace(rest, [True, False, False])
    np.testing.assert_allclose(points.min(axis=0), [-0.18, -0.18, 0.0], atol=2e-3)
    np.testing.assert_allclose(points.max(axis=0), [0.18, 0.18, 0.2], atol=2e-3)


def test_workspace_of_a_free_body_is_its_box_grown():
    points = workspace(box_corners([[0, 0, 0], [1, 1, 3]]))
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[-0.99] * 3, [1.99, 1.99, 3.99]])


def test_impossible_cameras_are_refused():
    with pytest.raises(ValueError, match="must not lie on one line"):
        Camera((0, 0, 1), (0, 0, 0))
    with pytest.raises(ValueError, match=r"fov .* must lie in"):
        Camera((0, -1, 0), (0, 0, 0), fov=180.0)
    with pytest.raises(ValueError, match="eye must be three finite numbers"):
        Camera((0, np.nan, 0), (0, 0, 0))
