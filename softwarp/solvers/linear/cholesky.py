"""Launches of the batched block Cholesky: factor, forward and backward substitution."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from softwarp.kernels.algebra import wide
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.linear import (
    cholesky,
    cholesky_levels,
    cholesky_panels,
    cholesky_runs,
    cholesky_strips,
    cholesky_wide,
)
from softwarp.kernels.rows.contact_panel import MOST_PANELS
from softwarp.model import memory
from softwarp.model.structure import Symbolic
from softwarp.solvers.linear import panels, strips, tiles
from softwarp.solvers.workspace.rows import Rows, allocate, shape

INDEX_ARRAYS = (
    "parent",
    "l_row",
    "l_col",
    "l_source",
    "col_start",
    "row_start",
    "row_block",
    "level_start",
    "level_col",
    "level_block_start",
    "level_block",
)
PAIRS = ("pair_start", "pair_left", "pair_right")  # of structures whose factor is found pair by pair: ``send_pairs``

PANEL_WORLDS = 640  # worlds up to which a block for each is the faster way without contacts; benchmarks/trunk.py
CONTACT_WORLDS = 1500  # the same with contacts; docs/performance.md
LEAST_SIZE, MOST_CONTACTS = 300, 144  # of scenes with contacts that were seen to be faster by levels beyond that
BLOCKS_AT_ONCE = 2  # thread blocks of panels that a multiprocessor has at a time, but for the factorisation
SIDE_GROUP = 3  # right-hand sides that one thread carries through a forward substitution


class LinearSolver:
    """``A = L L'`` of all worlds, with right-hand sides solved in place.

    On a CPU a thread handles whole worlds. On a GPU a thread block handles one world in panels; in large batches, and
    on structures too dense for panels, it takes a group of worlds through the levels of the elimination tree.

    Args:
        symbolic: Shared structure.
        index: Its arrays on the device, from :func:`upload`; those of pairs join them where they are needed.
        variant: Scalar type and memory order.
        world_count: Worlds of this solver.
        sides: Right-hand sides that ``forward`` can handle at once.
        device: Warp device.
        path: On a GPU, ``panels``, ``levels``, or ``auto`` by the number of worlds.
        contacts: Contacts of a world that may ask for their sides: ``auto`` then takes panels unless there are more
            than ``MOST_PANELS``, or many worlds of a large structure with few contacts.
    """

    def __init__(
        self,
        symbolic: Symbolic,
        index: dict[str, wp.array],
        variant: Variant,
        world_count: int,
        sides: int,
        device: Any,
        path: str = "auto",
        *,
        contacts: int = 0,
    ) -> None:
        self.symbolic = symbolic
        self.index = index
        self.variant = variant
        self.device = device
        is_wide = wide.is_wide(variant)
        self.kernels = cholesky_wide.kernels() if is_wide else cholesky.kernels(variant)
        self.strips = None  # substitutions by strips
        self.strip_names: tuple[str, ...] = ()  # of the factorisation's schedule; none: pair by pair
        if variant.lanes > 1 or is_wide:
            self.strip_names = strips.NAMES
        if variant.lanes > 1:
            self.strips = cholesky_strips.kernels()
        elif is_wide and strips.pay_alone(symbolic):
            self.strips, self.strip_names = cholesky_runs.kernels(), strips.RUN_NAMES
        packs, lanes = shape(variant, world_count)
        self.width = packs * lanes if variant.world_fastest else packs
        self.world_count = world_count
        padded = 1 if sides == 1 else SIDE_GROUP * -(-sides // SIDE_GROUP)
        spare = wide.PAD if is_wide else 0
        self.y: Rows = allocate(variant, world_count, 3 * symbolic.size * padded + spare, device)
        self.panels: PanelSolver | None = None
        prefers_panels = path == "panels" or (path == "auto" and world_count <= panel_worlds(symbolic, contacts))
        if variant.world_fastest and prefers_panels and panels.fits(symbolic, panel_limits(variant)):
            solver = PanelSolver(symbolic, variant, world_count, sides, self.y, device)
            if not contacts or len(solver.plan.panel) <= MOST_PANELS:
                self.panels = solver
                return
        self.levels: LevelSolver | None = None
        self.lower: Rows = allocate(variant, world_count, 9 * (symbolic.block_count + 1) + spare, device)
        self.diagonal: Rows = allocate(variant, world_count, 6 * symbolic.size, device)
        self.together: Rows | None = None
        if is_wide and self.strips is None and sides > 1:
            self.together = allocate(variant, world_count, 3 * wide.SIDES * symbolic.size, device)
        if variant.world_fastest:
            self.levels = LevelSolver(symbolic, variant, world_count, self.lower, self.diagonal, self.y, device)
        elif not self.strip_names:
            self.send_pairs()

    def send_pairs(self) -> None:
        """Copy the lists of pairs to the device, for a factorisation that goes pair by pair.

        They are by far the longest of a structure, 0.7 GB for the quadruped of 15 377 nodes, and strips, panels and
        levels do without.
        """
        for name in PAIRS:
            if name not in self.index:
                self.index[name] = wp.array(getattr(self.symbolic, name), dtype=wp.int32, device=self.device)

    @property
    def factors(self) -> list[wp.array]:
        """What ``factor`` leaves for the substitutions; put back, it need not be called again."""
        return [self.panels.lower] if self.panels is not None else [self.lower.real, self.diagonal.real]

    def factor(self, a: Rows) -> None:
        """Factorise the matrices whose stored blocks are ``a``."""
        if self.panels is not None:
            self.panels.factor(a)
            return
        if self.levels is not None:
            self.levels.factor(a)
            return
        i = self.index
        if self.strip_names:
            kernel = self.kernels.factor_world if self.strips is None else self.strips.factor_pack
            arrays = [i[name] for name in self.strip_names]
            inputs = [arrays[0].size - 1, *arrays, i["col_start"], i["l_source"], a.S]
            self._launch(kernel, self.width, inputs, [self.lower.S, self.diagonal.S])
            return
        pairs = [i[name] for name in PAIRS]
        inputs = [self.symbolic.size, i["col_start"], i["l_source"], *pairs, a.S]
        self._launch(self.kernels.factor_world, self.width, inputs, [self.lower.S, self.diagonal.S])

    def forward(self, sides: int) -> None:
        """``y <- L^-1 y`` for the first ``sides`` right-hand sides."""
        if self.panels is not None:
            self.panels.forward(sides)
            return
        if self.levels is not None:
            self.levels.forward(sides)
            return
        k, i, n = self.kernels, self.index, self.symbolic.size
        if self.strips is not None:
            inputs = self._strip_inputs()
            if sides == 1:
                self._launch(self.strips.forward_pack, self.width, inputs, [self.y.S])
            else:
                inputs = [n, -(-sides // SIDE_GROUP), *inputs]
                self._launch(self.strips.forward_pack3, self.width, inputs, [self.y.S])
            return
        inputs = [n, i["l_col"], i["row_start"], i["row_block"], self.lower.S, self.diagonal.S]
        if sides == 1:
            self._launch(k.forward_world, self.width, inputs, [self.y.S])
        elif self.together is not None:
            inputs.insert(1, sides)
            self._launch(k.forward_all, self.width, inputs, [self.together.S, self.y.S])
        else:
            self._launch(k.forward_world3, (self.width, -(-sides // SIDE_GROUP)), inputs, [self.y.S])

    def backward(self) -> None:
        """``y <- L^-T y`` for the first right-hand side."""
        if self.panels is not None:
            self.panels.backward()
            return
        if self.levels is not None:
            self.levels.backward()
            return
        i = self.index
        if self.strips is not None:
            self._launch(self.strips.backward_pack, self.width, self._strip_inputs(), [self.y.S])
            return
        inputs = [self.symbolic.size, i["l_row"], i["col_start"], self.lower.S, self.diagonal.S]
        self._launch(self.kernels.backward_world, self.width, inputs, [self.y.S])

    def _strip_inputs(self) -> list[Any]:
        i, start = self.index, self.index[self.strip_names[0]]
        return [start.size - 1, start, i["l_row"], i["col_start"], self.lower.S, self.diagonal.S]

    def _launch(self, kernel: Any, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


class LevelSolver:
    """``LinearSolver`` of a thread block for some neighbouring worlds, for variants without lanes.

    Args:
        symbolic: Shared structure.
        variant: Scalar type and memory order, of everything here.
        world_count: Worlds of this solver.
        lower: L, and a block of zeros behind it.
        diagonal: Inverses of the pivots' factors.
        y: Right-hand sides.
        device: Warp device; a CPU has one thread and one world to a block.
    """

    def __init__(
        self, symbolic: Symbolic, variant: Variant, world_count: int, lower: Rows, diagonal: Rows, y: Rows, device: Any
    ) -> None:
        self.plan = tiles.schedule(symbolic)
        self.variant, self.kernels = variant, cholesky_levels.kernels(variant)
        self.size, self.zero, self.world_count, self.device = symbolic.size, symbolic.block_count, world_count, device
        self.lower, self.diagonal, self.y = lower, diagonal, y
        self.is_parallel = wp.get_device(device).is_cuda
        self.worlds = cholesky_levels.worlds_per_block(world_count) if self.is_parallel else 1

        def send(values: np.ndarray) -> wp.array:
            return wp.array(values, dtype=wp.vec4i if values.ndim == 2 else wp.int32, device=device)

        self.index = {name: send(value) for name, value in vars(self.plan).items() if isinstance(value, np.ndarray)}
        sums = max(cholesky_levels.SIDES) * cholesky_levels.GROUP_ROWS * cholesky_levels.SPLIT
        rows = max(sums, cholesky_levels.TILE_ROWS * self.plan.part_count)
        self.part = allocate(variant, world_count, rows, device)
        self.corner = allocate(variant, world_count, 9 * self.plan.group_count, device)

    def factor(self, a: Rows) -> None:
        """Factorise the matrices whose stored blocks are ``a``."""
        pieces = ("level_piece", "piece", "entry", "level_split", "split")
        names = (*pieces, "level_tile", "tile", "tile_block", "tile_source")
        outputs = [self.part.S, self.corner.S, self.lower.S, self.diagonal.S]
        self._cooperate(self.kernels.factor_block, names, [self.zero], [a.S], outputs, cholesky_levels.FACTOR_THREADS)

    def forward(self, sides: int) -> None:
        """``y <- L^-1 y`` for the first ``sides`` right-hand sides."""
        if sides == 1:
            self._substitute("group_left", "left", is_backward=False)
            return
        padded = SIDE_GROUP * -(-sides // SIDE_GROUP)
        together = next(count for count in cholesky_levels.SIDES if padded % count == 0)
        kernel = cholesky_levels.forward_kernels(self.variant, together).forward_block
        names = ("level_group", "group", "group_left", "left")
        factors, outputs = [self.lower.S, self.diagonal.S], [self.part.S, self.y.S]
        self._cooperate(kernel, names, [self.size], [padded // together, *factors], outputs)

    def backward(self) -> None:
        """``y <- L^-T y`` for the first right-hand side."""
        self._substitute("group_below", "below", is_backward=True)

    def _substitute(self, start: str, items: str, *, is_backward: bool) -> None:
        names, factors = ("level_group", "group", start, items), [self.lower.S, self.diagonal.S]
        self._cooperate(self.kernels.substitute_block, names, [is_backward], factors, [self.part.S, self.y.S])

    def _team(self, threads: int) -> int:
        """Threads that a block of so many has on this device."""
        return threads if self.is_parallel else 1

    def _cooperate(
        self,
        kernel: Any,
        names: tuple[str, ...],
        first: list[Any],
        inputs: list[Any],
        outputs: list[Any],
        threads: int = cholesky_levels.THREADS,
    ) -> None:
        """Launch a kernel with one thread block for some worlds; ``first`` comes before the lists, ``inputs`` after."""
        threads = self._team(threads)
        lists = [self.plan.level_count, *(self.index[name] for name in names)]
        everything = [*first, *lists, self.world_count, self.worlds, threads, *inputs]
        dim = (-(-self.world_count // self.worlds), threads)
        wp.launch(kernel, dim=dim, inputs=everything, outputs=outputs, device=self.device, block_dim=threads)


class PanelSolver:
    """``LinearSolver`` of one thread block per world, for variants without lanes.

    Args:
        symbolic: Shared structure, whose columns all fit into a round.
        variant: Scalar type and memory order of A and ``y``; L and scratch have one world contiguous.
        world_count: Worlds of this solver.
        sides: Right-hand sides that ``forward`` can handle at once.
        y: Right-hand sides.
        device: Warp device.
        limits: What a round may hold, if less than the kernels can.

    Attributes:
        threads: Threads per block, but for the factorisation; a CPU has one.
        half: Half-solved right-hand sides, by column in order of rounds; (world, 3 n sides and more).
        skipped: 1 in worlds without substitutions; none, unless somebody puts another array here; (world, 1).
    """

    def __init__(
        self,
        symbolic: Symbolic,
        variant: Variant,
        world_count: int,
        sides: int,
        y: Rows,
        device: Any,
        limits: panels.Limits | None = None,
    ) -> None:
        self.plan = panels.schedule(symbolic, limits or panel_limits(variant))
        self.kernels = cholesky_panels.kernels(variant)
        self.world_count, self.y, self.device = world_count, y, device
        self.is_parallel = variant.world_fastest
        self.threads = self.team(substitution_threads(world_count, wp.get_device(device).sm_count))
        plan, n = self.plan, symbolic.size

        def send(values: np.ndarray) -> wp.array:
            kinds = {1: wp.int32, 2: wp.vec2i, 4: wp.vec4i}
            return wp.array(values, dtype=kinds[values.shape[1] if values.ndim == 2 else 1], device=device)

        self.index = {name: send(value) for name, value in vars(plan).items() if isinstance(value, np.ndarray)}

        def scratch(count: int) -> wp.array:
            return memory.zeros((world_count, max(count, 1)), variant.real, device)

        self.lower = scratch(plan.lower_rows)
        self.update = scratch(plan.update_rows)
        self.part = scratch(3 * sides * plan.row_count)
        self.half = scratch(3 * sides * (n + plan.column_limit))  # half-solved sides, then those of one round
        self.scratch = 3 * sides * n
        self.everyone = memory.zeros((world_count, 1), wp.int32, device)
        self.skipped = self.everyone

    def factor(self, a: Rows) -> None:
        """Factorise the matrices whose stored blocks are ``a``."""
        i = self.index
        rounds = [i[name] for name in ("round_item", "round_width", "round_late")]
        structure = [*rounds, *(i[name] for name in ("item_source", "item_place", "child", "late_row"))]
        inputs = [self.plan.round_count, *structure, self.team(cholesky_panels.THREADS), a.S]
        self.cooperate(self.kernels.factor_panels, inputs, [self.update, self.lower], cholesky_panels.THREADS)

    def forward(self, sides: int) -> None:
        """``y <- L^-1 y`` for the first ``sides`` right-hand sides."""
        i, plan = self.index, self.plan
        names = ("turn_column", "turn_row", "turn_lower", "column", "column_part", "row", "row_part", "part")
        structure = [i[name] for name in names]
        inputs = [plan.size, plan.row_count, plan.turn_count, *structure, sides, self.scratch, self.threads]
        inputs += [self.lower, self.skipped]
        self.cooperate(self.kernels.forward_panels, inputs, [self.part, self.half, self.y.S])

    def backward(self, u: Rows | None = None) -> None:
        """``y <- L^-T y`` for the first right-hand side, which is also added to ``u``."""
        i, plan = self.index, self.plan
        structure = [i[name] for name in ("turn_column", "turn_lower", "column", "column_lower", "row_index")]
        inputs = [plan.turn_count, *structure, self.scratch, self.threads]
        outputs = [self.half, self.y.S, (u or self.y).S]
        self.cooperate(self.kernels.backward_panels, [*inputs, u is not None, self.lower, self.skipped], outputs)

    def team(self, threads: int) -> int:
        """Threads that a block of so many has on this device."""
        return threads if self.is_parallel else 1

    def cooperate(
        self,
        kernel: Any,
        inputs: list[Any],
        outputs: list[Any],
        threads: int | None = None,
        items: int | None = None,
    ) -> None:
        """Launch a kernel with one thread block per world, or per world and item."""
        threads = self.threads if threads is None else self.team(threads)
        dim = (self.world_count, *([] if items is None else [items]), threads)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=threads)


def substitution_threads(world_count: int, multiprocessors: int) -> int:
    """Threads of a block that substitutes in panels or handles rows; every choice gives the same bits.

    Worlds that all have a block at the same time take large ones. More worlds than that take small ones, of which a
    multiprocessor has twice as many: while some wait at a barrier, others work; benchmarks/trunk.py.
    """
    threads = cholesky_panels.THREADS
    return threads if world_count <= BLOCKS_AT_ONCE * multiprocessors else threads // 2


def panel_worlds(symbolic: Symbolic, contacts: int) -> float:
    """Worlds up to which panels are the faster way: contacts of a world ask for sides, which panels do together."""
    if not contacts:
        return PANEL_WORLDS
    return CONTACT_WORLDS if symbolic.size >= LEAST_SIZE and contacts <= MOST_CONTACTS else math.inf


def panel_limits(variant: Variant) -> panels.Limits:
    """What a round of panels may hold."""
    items, stage = cholesky_panels.item_limit(variant), cholesky_panels.stage_limit(variant)
    return panels.Limits(items, cholesky_panels.SLOTS, stage)


def upload(symbolic: Symbolic, device: Any) -> dict[str, wp.array]:
    """Copy the index arrays of a structure but for its pairs to a device, those of its strips to a CPU."""
    arrays = {name: getattr(symbolic, name) for name in INDEX_ARRAYS}
    if wp.get_device(device).is_cpu:
        arrays |= vars(strips.schedule(symbolic))
        if strips.pay_alone(symbolic):
            arrays |= vars(strips.runs(symbolic))
    return {name: wp.array(values, dtype=wp.int32, device=device) for name, values in arrays.items()}
