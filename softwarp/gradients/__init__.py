"""Gradients through steps: a simulation as a function that torch differentiates. Theory: docs/theory/adjoint.md.

    rollout = gradients.Rollout(sim)
    youngs = torch.tensor([2e5], requires_grad=True)
    states = rollout(steps=50, parameters={"youngs": youngs})
    loss = (states.node_x[-1] - measured).square().sum()
    loss.backward()                                   # youngs.grad

``Equilibrium`` does the same for static solves, and ``jvp`` is the forward mode, for few directions.

How to use it, and what its limits are: docs/gradients.md.
"""

from softwarp.gradients.equilibrium import Equilibrium, Pose
from softwarp.gradients.forward import jvp
from softwarp.gradients.refusals import Diverged
from softwarp.gradients.rollout import Rollout, States

__all__ = ["Diverged", "Equilibrium", "Pose", "Rollout", "States", "jvp"]
