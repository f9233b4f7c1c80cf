"""A recorded trajectory as pictures, without the simulator."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp.io import colormap, palette
from softwarp.io.placement import Placement
from softwarp.io.trajectory import Trajectory
from softwarp.render.camera import Camera, around, within
from softwarp.render.raycaster import RayCaster
from softwarp.render.video import contact_sheet

Frames = NDArray[np.uint8]


def render_trajectory(
    trajectory: Trajectory,
    *,
    frames: ArrayLike | None = None,
    fps: float | None = None,
    worlds: Sequence[int] | None = None,
    width: int = 640,
    height: int = 480,
    camera: Camera | None = None,
    towards: ArrayLike | None = None,
    stress: bool | tuple[float, float] = True,
    contacts: bool = True,
    inversions: bool = True,
    joints: bool = False,
    twist: bool = False,
    samples: int = 16,
    device: str = "cpu",
) -> Frames:
    """Draw recorded frames; several worlds stand beside each other in each picture.

    Args:
        trajectory: What was recorded.
        frames: Indices of the frames to draw; None draws those nearest to a clock of ``fps``.
        fps: Pictures per second of recorded time; None draws every recorded frame.
        worlds: Numbers of the recorded worlds to draw; None draws all.
        width: Width of one world's picture [pixels].
        height: Height of one world's picture [pixels].
        camera: Where to look from; None sees all that happens.
        towards: Direction from there to the eye if ``camera`` is None, (3,); None looks from the front and above.
        stress: Whether to colour the bodies by von Mises stress where it was recorded; a pair sets the stresses [Pa]
            of the ends of the colour scale.
        contacts: Whether to show contacts where they were recorded: points, and arrows along the forces on the first
            part of their pairs, as long as they are strong.
        inversions: Whether to mark elements that are inside out, where that was recorded.
        joints: Whether to show the axes of joints.
        twist: Whether rods carry a stripe that shows their twist.
        samples: Rays for a pixel on an edge.
        device: Warp device.

    Returns:
        Pictures, shape (frame, height, width, 3), larger where several worlds are drawn.

    Raises:
        ValueError: For a frame or world that was not recorded.
    """
    rows = trajectory.world_rows(worlds)
    chosen = _frame_indices(trajectory, frames, fps)
    caster = RayCaster(
        trajectory.triangles,
        trajectory.vertex_rest,
        parts=trajectory.parts,
        placed=Placement.of_trajectory(trajectory, slice(0, 1), rows[0]),
        fixed=trajectory.vertex_fixed,
        cable_point_start=trajectory.cable_point_start,
        up=trajectory.up,
        region=_region(trajectory),
        tri_membrane=trajectory.tri_membrane,
        camera=camera,
        towards=towards,
        twist=twist,
        width=width,
        height=height,
        samples=samples,
        device=device,
    )
    stress_range = _stress_range(trajectory, rows, stress)
    options: dict[str, Any] = {"joints": joints, "contacts": contacts, "inversions": inversions}
    options |= {"stress_range": stress_range}
    pictures = [_draw_world(caster, trajectory, row, chosen, **options) for row in rows]
    if len(pictures) == 1:
        return pictures[0]
    return np.stack([contact_sheet(together) for together in zip(*pictures, strict=True)])


def _draw_world(
    caster: RayCaster,
    trajectory: Trajectory,
    row: int,
    chosen: NDArray[np.int64],
    *,
    stress_range: tuple[float, float] | None,
    contacts: bool,
    inversions: bool,
    joints: bool,
) -> Frames:
    """Chosen frames of one recorded world, drawn as if they were worlds."""
    taut, paint = palette.CABLE_TAUT, None
    if stress_range is not None and trajectory.stress is not None:
        taut = palette.CABLE_TAUT_ON_STRESS
        paint = colormap.colors(trajectory.stress[chosen, row], *stress_range)
        paint[:, trajectory.vertex_fixed] = palette.CLAMP
    tension = trajectory.cable_tension[chosen, row] / colormap.legible_limit(trajectory.cable_tension)
    placed = Placement.of_trajectory(trajectory, chosen, row)
    if not contacts:
        placed.contact_x = placed.contact_force = None
    if not inversions:
        placed.inverted_x = None
    return caster.render(
        trajectory.vertex_x[chosen, row],
        trajectory.cable_x[chosen, row],
        None if trajectory.goal is None else trajectory.goal[chosen, row],
        placed,
        node_color=paint,
        cable_color=colormap.blend(tension, palette.CABLE_SLACK, taut),
        pressure_limit=colormap.legible_limit(np.abs(trajectory.cavity_pressure)),
        force_limit=trajectory.strong_force(chosen),
        joints=joints,
    )


def _frame_indices(trajectory: Trajectory, frames: ArrayLike | None, fps: float | None) -> NDArray[np.int64]:
    if frames is not None and fps is not None:
        raise ValueError("render_trajectory: give frames or fps, not both")
    if frames is None:
        return np.arange(trajectory.frame_count) if fps is None else trajectory.frames_at(fps)
    chosen = np.atleast_1d(np.asarray(frames, dtype=np.int64))
    if chosen.size == 0 or chosen.min() < -trajectory.frame_count or chosen.max() >= trajectory.frame_count:
        raise ValueError(
            f"render_trajectory: frames must be indices below {trajectory.frame_count}, got {chosen.tolist()}"
        )
    return chosen


def _region(trajectory: Trajectory) -> NDArray[np.float64]:
    """Positions that the pictures must show, thinned to a few thousand.

    These are the places where bodies, rods and goals ever are; rigid bodies that stand still count as far as they are
    near to what moves.
    """
    parts, pose = trajectory.parts, trajectory.rigid_pose
    still = parts.rigid_kinematic & (np.ptp(pose, axis=0) < 1e-6).all(axis=(0, 2))
    points = [trajectory.vertex_x, trajectory.vertex_rest, parts.rod_outline(trajectory.rod_x)]
    points += parts.rigid_outline(pose, np.flatnonzero(~still))
    if trajectory.goal is not None:
        margin = 0.05 * trajectory.size()
        points += [trajectory.goal + side * margin for side in (-1.0, 1.0)]
    moved = np.concatenate([p.reshape(-1, 3) for p in points]).astype(np.float64)
    moved = moved[np.isfinite(moved).all(axis=1)]
    held = np.concatenate(parts.rigid_outline(pose[0, 0], np.flatnonzero(still)))
    if not len(moved):
        return held if len(held) else around(trajectory.bounds(), 0.0)
    extreme = np.unique(np.concatenate([moved.argmin(axis=0), moved.argmax(axis=0)]))
    shown = np.concatenate([moved[:: max(1, len(moved) // 4000)], moved[extreme]])
    return np.concatenate([shown, within(held, shown, 0.3)])


def _stress_range(
    trajectory: Trajectory, rows: list[int], stress: bool | tuple[float, float]
) -> tuple[float, float] | None:
    if stress is False or trajectory.stress is None:
        return None
    return (0.0, colormap.legible_limit(trajectory.stress[:, rows])) if stress is True else stress
