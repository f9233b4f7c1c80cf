"""Identification: physical parameters from measured poses and trajectories, many candidates at a time.

    parameters = [Parameter("youngs", 1e5, 1e6, scale="log", unit="Pa", target="youngs", item=body)]
    worlds = Worlds(sim, parameters)                  # a candidate in every world

    def residuals(values):                            # (candidate, parameter) -> (candidate, measurement)
        sim.reset()
        worlds.write(values)
        sim.step(200)
        return worlds.gather(sim.marker_x[:, tip]) - measured

    found = fit(parameters, residuals, batch=worlds.candidates)
    print(found.table())

How to use it, and what its intervals mean: docs/identification.md.
"""

from softwarp.identification.devices import side_by_side
from softwarp.identification.fitting import fit, leave_out
from softwarp.identification.gradients import Differentiable
from softwarp.identification.parameters import Parameter
from softwarp.identification.result import Fit, LeftOut
from softwarp.identification.worlds import Worlds

__all__ = ["Differentiable", "Fit", "LeftOut", "Parameter", "Worlds", "fit", "leave_out", "side_by_side"]
