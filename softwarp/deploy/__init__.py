"""Policies and plans on robots: loaded, exported to one file, run at a fixed rate, played from a file of commands."""

from softwarp.deploy.commands import Channel, Check, CommandFile, Player
from softwarp.deploy.controller import Controller, Timing
from softwarp.deploy.policy import LoadedPolicy, load_policy

__all__ = [
    "Channel",
    "Check",
    "CommandFile",
    "Controller",
    "LoadedPolicy",
    "Player",
    "Timing",
    "load_policy",
]
