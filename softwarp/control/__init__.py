"""Control of simulated robots without learning."""

from softwarp.control.effectors import Effector, OrientationEffector, PointEffector
from softwarp.control.inverse import InverseController, Solution
from softwarp.control.policy import InversePolicy, Steerable
from softwarp.model.codes import Outcome

__all__ = [
    "Effector",
    "InverseController",
    "InversePolicy",
    "OrientationEffector",
    "Outcome",
    "PointEffector",
    "Solution",
    "Steerable",
]
