"""Pictures and films of simulated worlds, without a window."""

from softwarp.render.camera import Camera
from softwarp.render.raycaster import RayCaster
from softwarp.render.replay import render_trajectory
from softwarp.render.video import contact_sheet, write_png, write_video

__all__ = ["Camera", "RayCaster", "contact_sheet", "render_trajectory", "write_png", "write_video"]
