"""Control of simulated robots without learning."""

from softwarp.control.effectors import Effector, OrientationEffector, PointEffector
from softwarp.control.following import Followed, TargetPath, follow
from softwarp.control.inverse import InverseController, Solution
from softwarp.control.policy import InversePolicy, Steerable, SteerableTubes
from softwarp.control.tilt import TiltController
from softwarp.control.tubes import TubeController, TubeSolution
from softwarp.model.codes import Outcome
from softwarp.solvers.inverse.grip import Grip

__all__ = [
    "Effector",
    "Followed",
    "Grip",
    "InverseController",
    "InversePolicy",
    "OrientationEffector",
    "Outcome",
    "PointEffector",
    "Solution",
    "Steerable",
    "SteerableTubes",
    "TargetPath",
    "TiltController",
    "TubeController",
    "TubeSolution",
    "follow",
]
