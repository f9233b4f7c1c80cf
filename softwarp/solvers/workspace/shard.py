"""What terms stand on: some worlds of a model, their inputs, and the workspace of a step."""

from __future__ import annotations

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.model.fields import declarations
from softwarp.model.model import Model
from softwarp.model.state import Control, Parameters, State
from softwarp.solvers.options import Options
from softwarp.solvers.workspace import rows, workspace
from softwarp.solvers.workspace.launches import Launches
from softwarp.solvers.workspace.rows import Rows

SLID = ("pose0", "twist0")  # inputs that telescopes change before a step, which must leave the state as it is


class Shard(Launches):
    """Worlds that step together.

    Args:
        model: Scene.
        variant: Scalar type and memory order.
        state, control, parameters: The worlds' arrays.
        options: Solver options.
        exact: Give the workspace room for the exact tangent of statics.

    Attributes:
        work: Workspace.
        input: What a step reads as workspace arrays: of ``State`` what has a ``start``, under that name, commands as
            ``command_`` and their name, parameters under their names. The same memory, or copies that ``load``
            makes.
        felt: What momentum and damping are found with: ``v0`` and ``twist0`` of the start, ``dof_v`` of now, and
            ``beta``, the factors of K that damp. A term that is ``leaning`` puts other ones here.
        is_settled: Whether a step has left the state as it is: finite, and with nodes where modes have them.
        leaning: Whether one does, so that ``dof_v`` counts although no velocity has been found in this step.
    """

    def __init__(
        self,
        model: Model,
        variant: Variant,
        state: State,
        control: Control,
        parameters: Parameters,
        options: Options,
        exact: bool,
    ) -> None:
        super().__init__(variant, int(state.node_x.shape[0]), model.device)
        self.model, self.options, self.exact = model, options, exact
        self.state, self.control, self.parameters = state, control, parameters
        self.work = workspace.allocate(model, variant, self.world_count, exact)
        self.blocks = len(model.symbolic.a_row)
        self.dof_rows, self.dof_room = 3 * model.dof_count, 3 * model.dof_room
        sources = {d["start"]: getattr(state, name) for name, d in declarations(State).items() if d["start"]}
        sources |= {f"command_{name}": getattr(control, name) for name in declarations(Control)}
        sources |= {name: getattr(parameters, name) for name in declarations(Parameters)}
        self.input: dict[str, Rows] = {}
        self._interleaved: dict[str, tuple[wp.array, Rows]] = {}
        for name, array in sources.items():
            if array.shape[1] == 0:
                self.input[name] = self.rows(1)
            elif variant.lanes > 1 or (model.telescopes is not None and name in SLID):
                self.input[name] = self.rows(array.shape[1])
                self._interleaved[name] = array, self.input[name]
            else:
                self.input[name] = rows.alias(variant, array)
        self.leaning = self.is_settled = False
        self.felt = {name: self.input[name] for name in ("v0", "twist0")}
        self.felt |= {"dof_v": self.work.dof_v, "beta": self.input["rayleigh_stiffness"]}

    def load(self, *, without: tuple[str, ...] = ()) -> None:
        """Bring state, commands and parameters into the workspace's memory order, but for some inputs by name."""
        for array, target in (pair for name, pair in self._interleaved.items() if name not in without):
            inputs = [array, self.world_count, self.lanes]
            self.each_real(self.k_state.interleave, None, inputs, [target.real])

    def check_finite(self, values: Rows, count: int) -> None:
        """Raise the flags of worlds where one of the first rows of ``values`` is not finite; none if ``is_settled``."""
        if self.is_settled:
            return
        inputs = [count, values.real]
        self.each_real(self.k_state.check_rows, self.variant.parts(count), inputs, [self.work.flag.real])
