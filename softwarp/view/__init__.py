"""Simulated robots live in a browser, and recordings of them."""

from softwarp.view.panel import HAND
from softwarp.view.reel import Player, Reel, write_html
from softwarp.view.stage import Stage
from softwarp.view.viewer import Viewer
from softwarp.view.window import Window

__all__ = ["HAND", "Player", "Reel", "Stage", "Viewer", "Window", "write_html"]
