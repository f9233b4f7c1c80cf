"""Steps that worlds take again by Newton's method, where one linearisation swings a line too far.

Theory: docs/theory/telescope.md, "Swings".
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from softwarp.kernels.algebra.lanes import LANE_COUNT
from softwarp.kernels.step import repeats, stages
from softwarp.model import memory
from softwarp.model.fields import allocate, declarations
from softwarp.model.handles import Telescope
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
LOOKS = 1  # of an iteration at contacts where it leads to: along the plane of a curved wall a line slides into it
TOLERANCE = 1e-3  # relative force imbalance that ends them
DEEP = 0.5  # radii of a line that an iterate may lie in what it touches at no cost to its merit
SWEEPS = 25  # over contacts in an iteration, at most, from the forces of the one before: a GPU waits for all of them
ON_GPU = (4, 8, 64)  # worlds of a batch for each place where steps are repeated


class Places:
    """A system with a workspace for some worlds, which brings Newton's method to an end there.

    Args:
        system: Worlds that may come here.
        count: Places.
        h: Length of a step [s].
        state: Rows of ``State`` that they bring and take, by name.
    """

    def __init__(self, system: System, count: int, h: float, state: dict[str, wp.array]) -> None:
        self.count, self.shard, self.state = count, system.shard, state
        self.k = repeats.kernels(system.variant)
        model = replace(system.model, num_worlds=count)
        here = (create(State, model), create(Control, model), create(Parameters, model))
        options = twin_options(system.options, system.model.precision)
        self.twin = System(model, system.index, system.variant, here[0], here[1], here[2], options)
        self.control = NewtonControl(self.twin, still=True, deepest=deepest(system.model))
        self.newton = ImplicitEuler(self.twin, h, control=self.control, tells=False, swings=SWINGS, brief=True)
        self.inputs: list[tuple[wp.array, wp.array]] = []
        for whole, part in ((self.shard.control, here[1]), (self.shard.parameters, here[2])):
            pairs = [(getattr(whole, name), getattr(part, name)) for name in declarations(whole)]
            self.inputs += [pair for pair in pairs if pair[0].shape[1]]

    def step(self, start: dict[str, wp.array], progress: wp.array, order: wp.array) -> None:
        """The next worlds take the step, as many as there are places.

        Args:
            start: Their rows before it.
            progress: How many have taken it, and how many will.
            order: Their numbers.
        """
        here = self.twin.state
        for source, target in [*((start[name], getattr(here, name)) for name in self.state), *self.inputs]:
            kernel = self.k.take_integers if target.dtype is wp.int32 else self.k.take
            self._copy(kernel, target.shape[1], [source, progress, order], target)
        t = self.twin.shard
        t.each_real(self.k.spare, None, [t.lanes, progress], [self.control.spare.real])
        self.newton.step()
        for name, target in self.state.items():
            if name != "status":
                kernel = self.k.give_integers if target.dtype is wp.int32 else self.k.give
                source = getattr(here, name)
                self._copy(kernel, target.shape[1], [source, here.status, progress, order], target)
        inputs = [here.status, here.status, progress, order]
        self._copy(self.k.give_integers, 1, inputs, self.state["status"])

    def _copy(self, kernel: Any, rows: int, inputs: list[Any], target: wp.array) -> None:
        variant = self.shard.variant
        dim = variant.dim(self.count, variant.parts(rows))
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[target], device=self.shard.device)


class RepeatingEuler:
    """Backward Euler steps of one linearisation, which worlds whose lines it swings too far take again.

    These few worlds go, some at a time, to places of their own. All other worlds keep what they have, to the bit. Where
    Newton's step fails, the linear one stands; whether it has converged is not told, since linear steps are never
    asked. A GPU has places for few and for more of them, and takes the fewest that are enough, or the most that it has.

    Args:
        system: Worlds; ``Options.repeat_swing`` is theirs.
        h: Length of a step [s].
    """

    def __init__(self, system: System, h: float) -> None:
        self.system, self.shard = system, system.shard
        self.euler = ImplicitEuler(system, h)
        self.k, self.k_copy = repeats.kernels(system.variant), stages.kernels(system.variant)
        s, worlds = self.shard, system.world_count
        state = {name: getattr(s.state, name) for name in declarations(State)}
        self.state = {name: array for name, array in state.items() if array.shape[1]}
        self.start = {name: allocate(worlds, a.shape[1], a.dtype, s.device) for name, a in self.state.items()}
        self.places = [Places(system, count, h, self.state) for count in _places(system)]
        counts = [places.count for places in self.places]
        self.fewer = wp.array([*counts[1:], 0], dtype=wp.int32, device=s.device)
        self.again = memory.zeros((s.packs, 1, s.lanes), wp.int32, s.device)
        self.order = memory.zeros((worlds,), wp.int32, s.device)
        self.groups = memory.zeros((-(-worlds // repeats.GROUP),), wp.int32, s.device)
        self.progress = memory.zeros((repeats.ROWS,), wp.int32, s.device)
        self.left = memory.zeros((1,), wp.int32, s.device)
        self.more = memory.zeros((len(counts),), wp.int32, s.device)

    @property
    def always(self) -> bool:
        """Whether all is done without asking which worlds need it, as where a recording cannot branch."""
        return self.system.always

    @always.setter
    def always(self, value: bool) -> None:
        self.system.always = self.places[0].twin.always = value

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
            for _ in range(-(-self.system.world_count // self.places[0].count)):
                self._repeat(self.places[0])
        else:
            wp.capture_while(self.left, partial(self._repeat_within, 0))

    def _choose(self) -> None:
        """Which worlds repeat the step."""
        s = self.shard
        self.progress.zero_()
        self.order.zero_()
        self.groups.zero_()
        inputs = [s.options.repeat_swing, s.lanes, s.world_count, s.work.swing.real]
        s.each_real(self.k.choose, None, inputs, [self.again, self.progress, self.groups])
        s.each_real(self.k.number, None, [s.lanes, self.again, self.groups], [self.order])
        self._go_on(0)

    def _keep(self) -> None:
        """Their state is kept, before the linear step changes it."""
        s = self.shard
        for name, array in self.state.items():
            kernel = self.k_copy.choose_integers if array.dtype is wp.int32 else self.k_copy.choose
            s.each_real(kernel, s.variant.parts(array.shape[1]), [1, s.lanes, array, self.again], [self.start[name]])

    def _repeat_within(self, first: int) -> None:
        """In the fewest places from the ``first`` ones on that are enough for all that are left."""
        here, fewer = partial(self._repeat, self.places[first]), first + 1
        if fewer == len(self.places):
            here()
        else:
            wp.capture_if(self.more[first:fewer], here, partial(self._repeat_within, fewer))

    def _repeat(self, places: Places) -> None:
        """As many of them as there are places take the step."""
        places.step(self.start, self.progress, self.order)
        self._go_on(places.count)

    def _go_on(self, places: int) -> None:
        outputs = [self.progress, self.left, self.more]
        wp.launch(self.k.go_on, dim=1, inputs=[places, self.fewer], outputs=outputs, device=self.shard.device)


def repeats_steps(model: Model, options: Options) -> bool:
    """Whether worlds of a scene may take steps again."""
    is_linear = options.integrator == "euler" and options.newton_iterations == 1
    return model.telescopes is not None and is_linear and options.repeat_swing < float("inf")


def twin_options(options: Options, precision: str) -> Options:
    """Options of the steps that are repeated: more iterations, and what penetrates is taken back whole.

    In float64 an iteration solves once, and once more for what it comes to touch: the next one corrects what is left.
    In float32 it cannot measure what that leaves, so its pass of refinement, in which it looks at contacts too, stays.
    """
    return replace(
        options,
        refinement=options.refinement if precision == "float32" else 0,
        newton_iterations=ITERATIONS,
        newton_tolerance=TOLERANCE,
        gauss_seidel_iterations=min(SWEEPS, options.gauss_seidel_iterations),
        most_swing=SWING,
        iterated_passes=LOOKS,
        further_passes=0,
        recovery_time=0.0,
        repeat_swing=float("inf"),
    )


def deepest(model: Model) -> NDArray[np.float64] | None:
    """How deep [m] lines of telescopes may lie in what they touch at no cost, inf for other pairs of parts, (pair,)."""
    if model.contact is None or model.frames is None:
        return None
    found = np.full(model.contact.count, np.inf)
    for pair, parts in enumerate(model.contact.parts):
        for part in parts:
            if isinstance(part, Telescope):
                radius = model.frames.rod_radius[model.rod_nodes(part)].min()
                found[pair] = min(found[pair], DEEP * float(radius))
    return found


def _places(system: System) -> list[int]:
    """Worlds that repeat a step together, the most first: one, or as many as lanes; on a GPU some of each size."""
    if system.variant.world_fastest:
        counts = {-(-system.world_count // each) for each in ON_GPU}
        return sorted(counts, reverse=True)
    return [LANE_COUNT if system.variant.lanes > 1 else 1]
