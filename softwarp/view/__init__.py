"""Simulated robots live in a browser."""

from softwarp.view.panel import HAND
from softwarp.view.stage import Stage
from softwarp.view.viewer import Viewer
from softwarp.view.window import Window

__all__ = ["HAND", "Stage", "Viewer", "Window"]
