"""The server of a page: quiet, lit so that a browser without a GPU keeps up, its panel beside the picture."""

from __future__ import annotations

import contextlib
import importlib
import io
from typing import Any

from softwarp import checks

LOCAL = "127.0.0.1"
PORT = 8080
FPS = 60.0  # pictures per second, as screens have them
_SKY, _GROUND = (255, 255, 255), (150, 160, 170)
_SKYLIGHT = 2.2


def serve(host: str, port: int) -> Any:
    """Start a ``viser.ViserServer``; ``stop`` ends it.

    Light comes from lamps and a sky of two colours. viser's own, from a picture of surroundings, takes a browser that
    draws in software over ten times as long for each of its pictures.

    Args:
        host: Address to listen at; ``"0.0.0.0"`` lets other machines connect.
        port: First port that is tried; the next free one is taken.

    Raises:
        ImportError: Without viser.
        ValueError: For a port out of range.
    """
    checks.count(port, "viewer: port", high=65535)
    try:
        viser = importlib.import_module("viser")
    except ImportError as error:
        raise ImportError("the viewer needs viser, which is not installed; pip install 'softwarp[view]'") from error
    with contextlib.redirect_stdout(io.StringIO()):  # it prints addresses
        server = viser.ViserServer(host=host, port=port, label="softwarp", verbose=False)
    server.gui.configure_theme(show_share_button=False)  # which would open a way in from the internet
    server.gui.main_panel.dock_right()  # instead of in front of the robot
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere("/sky", sky_color=_SKY, ground_color=_GROUND, intensity=_SKYLIGHT)
    return server


def stop(server: Any) -> None:
    """Let browsers go and free the port."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def url(server: Any, host: str) -> str:
    """Where browsers look."""
    return f"http://{'localhost' if host == LOCAL else host}:{server.get_port()}"
