"""Steps that worlds take again by Newton's method, where one linearisation swings a line too far.

Theory: docs/theory/telescope.md, "Swings".
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT
from softwarp.kernels.step import repeats, stages
from softwarp.model import memory
from softwarp.model.fields import allocate, declarations
from softwarp.model.model import Model
from softwarp.model.state import Control, Parameters, State, create
from softwarp.solvers.implicit_euler import ImplicitEuler
from softwarp.solvers.newton_control import NewtonControl
from softwarp.solvers.options import Options
from softwarp.solvers.system import System

ITERATIONS = 20  # of Newton's method, at most
SWING = 0.5  # rad, that an iteration may swing a line by
FREE, LESS = 8, 0.7  # iterations that may do so in full, and what each further one may of the one before: some end in
# two sets of contacts that lead to each other
SWINGS = (*[1.0] * FREE, *(LESS**k for k in range(1, ITERATIONS - FREE + 1)))
TOLERANCE = 1e-3  # relative force imbalance that ends them
SWEEPS = 25  # over contacts in an iteration, at most, from the forces of the one before: a GPU waits for all of them
ON_GPU = 8  # worlds of a batch for each place where steps are repeated


class RepeatingEuler:
    """Backward Euler steps of one linearisation, which worlds whose lines it swings too far take again.

    These few worlds go, some at a time, to places of their own: a system with a workspace for that many, which brings
    Newton's method to an end there. All other worlds keep what they have, to the bit. Where Newton's step fails, the
    linear one stands; whether it has converged is not told, since linear steps are never asked.

    Args:
        system: Worlds; ``Options.repeat_swing`` is theirs.
        h: Length of a step [s].
    """

    def __init__(self, system: System, h: float) -> None:
        self.system, self.shard = system, system.shard
        self.euler = ImplicitEuler(system, h)
        self.k, self.k_copy = repeats.kernels(system.variant), stages.kernels(system.variant)
        s, worlds = self.shard, system.world_count
        self.places = _places(system)
        model = replace(system.model, num_worlds=self.places)
        here = (create(State, model), create(Control, model), create(Parameters, model))
        options = twin_options(system.options, system.model.precision)
        self.twin = System(model, system.index, system.variant, here[0], here[1], here[2], options)
        self.control = NewtonControl(self.twin, still=True)
        self.newton = ImplicitEuler(self.twin, h, control=self.control, tells=False, swings=SWINGS, brief=True)
        state = {name: getattr(s.state, name) for name in declarations(State)}
        self.state = {name: array for name, array in state.items() if array.shape[1]}
        self.start = {name: allocate(worlds, a.shape[1], a.dtype, s.device) for name, a in self.state.items()}
        self.held = [(self.start[name], getattr(here[0], name)) for name in self.state]
        for whole, part in ((s.control, here[1]), (s.parameters, here[2])):
            pairs = [(getattr(whole, name), getattr(part, name)) for name in declarations(whole)]
            self.held += [pair for pair in pairs if pair[0].shape[1]]
        self.found = [(getattr(here[0], name), array) for name, array in self.state.items()]
        self.again = memory.zeros((s.packs, 1, s.lanes), wp.int32, s.device)
        self.order = memory.zeros((worlds,), wp.int32, s.device)
        self.progress = memory.zeros((repeats.ROWS,), wp.int32, s.device)
        self.left = memory.zeros((1,), wp.int32, s.device)

    @property
    def always(self) -> bool:
        """Whether all is done without asking which worlds need it, as where a recording cannot branch."""
        return self.system.always

    @always.setter
    def always(self, value: bool) -> None:
        self.system.always = self.twin.always = value

    def step(self) -> None:
        """Advance by one step."""
        self.euler.advance()
        self._choose()
        if self.always:
            self._keep()
        else:
            wp.capture_if(self.left, self._keep)
        self.euler.finish()
        if self.always:
            for _ in range(-(-self.system.world_count // self.places)):
                self._repeat()
        else:
            wp.capture_while(self.left, self._repeat)

    def _choose(self) -> None:
        """Which worlds repeat the step."""
        s = self.shard
        self.progress.zero_()
        self.order.zero_()
        inputs = [s.options.repeat_swing, s.lanes, s.world_count, s.work.swing.real]
        s.each_real(self.k.choose, None, inputs, [self.again, self.progress])
        s.each_real(self.k.number, None, [s.lanes, self.again], [self.order])
        self._go_on(0)

    def _keep(self) -> None:
        """Their state is kept, before the linear step changes it."""
        s = self.shard
        for name, array in self.state.items():
            kernel = self.k_copy.choose_integers if array.dtype is wp.int32 else self.k_copy.choose
            s.each_real(kernel, s.variant.parts(array.shape[1]), [1, s.lanes, array, self.again], [self.start[name]])

    def _repeat(self) -> None:
        """As many of them as there are places take the step."""
        for source, target in self.held:
            kernel = self.k.take_integers if target.dtype is wp.int32 else self.k.take
            self._copy(kernel, target.shape[1], [source, self.progress, self.order], target)
        t = self.twin.shard
        t.each_real(self.k.spare, None, [t.lanes, self.progress], [self.control.spare.real])
        self.newton.step()
        status = self.twin.state.status
        for source, target in self.found:
            if source is not status:
                kernel = self.k.give_integers if target.dtype is wp.int32 else self.k.give
                self._copy(kernel, target.shape[1], [source, status, self.progress, self.order], target)
        self._copy(self.k.give_integers, 1, [status, status, self.progress, self.order], self.state["status"])
        self._go_on(self.places)

    def _copy(self, kernel: Any, rows: int, inputs: list[Any], target: wp.array) -> None:
        variant = self.shard.variant
        dim = variant.dim(self.places, variant.parts(rows))
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[target], device=self.shard.device)

    def _go_on(self, places: int) -> None:
        outputs = [self.progress, self.left]
        wp.launch(self.k.go_on, dim=1, inputs=[places], outputs=outputs, device=self.shard.device)


def repeats_steps(model: Model, options: Options) -> bool:
    """Whether worlds of a scene may take steps again."""
    is_linear = options.integrator == "euler" and options.newton_iterations == 1
    return model.telescopes is not None and is_linear and options.repeat_swing < float("inf")


def twin_options(options: Options, precision: str) -> Options:
    """Options of the steps that are repeated: more iterations, and what penetrates is taken back whole.

    In float64 an iteration solves once: the next one corrects it. In float32 it cannot measure what that leaves.
    """
    return replace(
        options,
        refinement=options.refinement if precision == "float32" else 0,
        newton_iterations=ITERATIONS,
        newton_tolerance=TOLERANCE,
        gauss_seidel_iterations=min(SWEEPS, options.gauss_seidel_iterations),
        most_swing=SWING,
        further_passes=0,
        recovery_time=0.0,
        repeat_swing=float("inf"),
    )


def _places(system: System) -> int:
    """Worlds that repeat a step together: one, or as many as lanes; on a GPU, where time hardly depends on it, many."""
    if system.variant.world_fastest:
        return -(-system.world_count // ON_GPU)
    return LANE_COUNT if system.variant.lanes > 1 else 1
