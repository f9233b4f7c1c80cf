"""Trained policies outside training: loaded, exported to one file, and run at a fixed rate."""

from softwarp.deploy.controller import Controller, Timing
from softwarp.deploy.policy import LoadedPolicy, load_policy

__all__ = ["Controller", "LoadedPolicy", "Timing", "load_policy"]
