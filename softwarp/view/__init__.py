"""Simulated robots live in a browser."""

from softwarp.view.panel import HAND
from softwarp.view.stage import Stage
from softwarp.view.viewer import Viewer

__all__ = ["HAND", "Stage", "Viewer"]
