"""How pictures look: light, floor, colours, and the rays of a camera, as the kernels need them."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.io import palette
from softwarp.io.colormap import srgb_to_linear
from softwarp.render import raycast
from softwarp.render.camera import Camera, horizontal_axes
from softwarp.render.layer import upload
from softwarp.shapes.base import quaternion_of

Floats = NDArray[np.float64]

_CABLE_GLOW = 0.75  # how strongly a cable just below the surface shows
_CABLE_SINK = 0.03  # of the size of the body: depth at which that has fallen to a third
_CHAMBER_GLOW = 0.72  # how strongly a chamber just below the surface shows
_CHAMBER_SINK = 0.35  # of the size of the body: depth at which that has fallen to a third
_NOTE_GLOW = 0.45  # how strongly arrows show behind something


def look_of(region: Floats, up: Floats, camera: Camera, size: float, cable_radius: float, goal_radius: float) -> Any:
    """Light, floor and colours for the positions to show [m] and a body of a size [m].

    The key light stands above, behind the left shoulder of whoever looks through the camera.
    """
    up = up / np.linalg.norm(up)
    side, depth = horizontal_axes(up)
    low, high = region.min(axis=0), region.max(axis=0)
    centre = 0.5 * (low + high)
    centre = centre + (np.min(region @ up) - centre @ up - 0.01 * size) * up
    right = camera.basis()[0]
    light = 0.86 * up - 0.40 * right + 0.30 * np.cross(right, up)
    look = raycast.Look()
    look.up, look.side, look.depth = wp.vec3(*up), wp.vec3(*side), wp.vec3(*depth)
    look.light = wp.vec3(*(light / np.linalg.norm(light)))
    look.centre = wp.vec3(*centre)
    look.floor_cell = _round_length(size / 4.0)
    look.fade = 1.2 * float(np.linalg.norm(high - low)) + 1.5 * size
    look.nudge = 2e-3 * size
    look.cable_radius, look.goal_radius = cable_radius, goal_radius
    look.cable_glow, look.cable_sink = _CABLE_GLOW, _CABLE_SINK * size
    look.chamber_glow, look.chamber_sink = _CHAMBER_GLOW, _CHAMBER_SINK * size
    look.note_glow = _NOTE_GLOW
    for name, color in (
        ("background", palette.BACKGROUND),
        ("floor_even", palette.FLOOR_EVEN),
        ("floor_odd", palette.FLOOR_ODD),
        ("goal_color", palette.GOAL),
        ("membrane_color", palette.MEMBRANE),
    ):
        setattr(look, name, wp.vec3(*srgb_to_linear(color)))
    return look


def view_of(camera: Camera, width: int, height: int) -> Any:
    """The rays of a camera's picture."""
    right, upwards, forward = camera.basis()
    pixel = 2.0 * np.tan(0.5 * np.radians(camera.fov)) / height
    view = raycast.View()
    view.eye = wp.vec3(*camera.eye)
    view.corner = wp.vec3(*(forward - 0.5 * width * pixel * right + 0.5 * height * pixel * upwards))
    view.step_x = wp.vec3(*(pixel * right))
    view.step_y = wp.vec3(*(-pixel * upwards))
    view.pixel = pixel
    view.width, view.height = width, height
    return view


def _round_length(length: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten."""
    steps = np.array([1.0, 2.0, 5.0, 10.0]) * 10.0 ** np.floor(np.log10(length))
    return float(steps[np.argmin(np.abs(np.log(steps / length)))])


def default_floor(look: Any, up: Floats, device: str) -> wp.array:
    """Pose of the floor below the middle of the picture."""
    turn = quaternion_of(np.stack([*horizontal_axes(up), up], axis=1))
    return upload(np.concatenate([look.centre, turn])[None], device, wp.transform)
