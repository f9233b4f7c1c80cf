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


def test_workspace_holds_the_bends_of_a_clamped_beam():
    """A beam along +z from a fixed end, bent to arcs of 1 rad: its tip comes L (1 - cos 1) to all sides, not below."""
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])
    points = workspace(rest, [True, False, False])
    beside = 0.2 * (1.0 - np.cos(1.0))
    np.testing.assert_allclose(points.min(axis=0), [-beside, -beside, 0.0], atol=1e-3)
    np.testing.assert_allclose(points.max(axis=0), [beside, beside, 0.2], atol=1e-3)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0)])
def test_a_clamped_beam_fills_the_picture_of_its_workspace(up):
    """Upright it takes more than two thirds of the height, where half a ball of reach left it half."""
    rest = np.linspace(0.0, 0.2, 9)[:, None] * np.asarray(up)
    at, _ = project(Camera.seeing(workspace(rest, np.arange(9) == 0), up), rest, 4.0 / 3.0)
    assert 0.5 * np.ptp(at[:, 1]) > 2.0 / 3.0
    assert np.abs(at).max() < 1.0


def test_workspace_of_a_free_body_is_its_box_grown():
    points = workspace(box_corners([[0, 0, 0], [1, 1, 3]]))
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[-0.36] * 3, [1.36, 1.36, 3.36]])


def test_workspace_of_a_body_held_all_around_is_its_box_grown():
    rest = box_corners([[0, 0, 0], [1, 1, 1]])
    points = workspace(np.concatenate([rest, [[0.5, 0.5, 0.5]]]), [True] * 8 + [False])
    np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[-0.12] * 3, [1.12] * 3])


def test_projection_is_that_of_a_pinhole():
    """As computed here by other means; what lies behind comes out infinite."""
    camera = Camera.seeing(box_corners([[0, 0, 0], [1, 2, 1]]), towards=(1.0, 0.3, 0.2))
    points = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 1.0]])
    np.testing.assert_allclose(camera.project(points, 1.5), project(camera, points, 1.5)[0])
    behind = 2.0 * np.asarray(camera.eye) - camera.target
    assert np.isinf(camera.project(behind)).all()


def test_direction_of_view_can_be_chosen():
    corners = box_corners([[0, 0, 0], [1, 2, 1]])
    camera = Camera.seeing(corners, towards=(0.0, -2.0, 0.0))
    np.testing.assert_allclose(camera.basis()[2], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.abs(camera.project(corners)).max() == pytest.approx(1.0 / 1.08)


def test_impossible_cameras_are_refused():
    with pytest.raises(ValueError, match="must not lie on one line"):
        Camera((0, 0, 1), (0, 0, 0))
    with pytest.raises(ValueError, match=r"fov .* must lie in"):
        Camera((0, -1, 0), (0, 0, 0), fov=180.0)
    with pytest.raises(ValueError, match="eye must be three finite numbers"):
        Camera((0, np.nan, 0), (0, 0, 0))
