"""Control of simulated robots without learning."""

from softwarp.control.effectors import Effector, OrientationEffector, PointEffector
from softwarp.control.inverse import InverseController, Outcome, Solution

__all__ = ["Effector", "InverseController", "OrientationEffector", "Outcome", "PointEffector", "Solution"]
