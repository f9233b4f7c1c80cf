"""What a batch of worlds takes: the memory of a simulation, told without allocating it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from softwarp.model import memory
from softwarp.model.model import Model
from softwarp.model.state import Control, Parameters, State, create, worlds_slice
from softwarp.solvers.linear.cholesky import upload
from softwarp.solvers.options import Options
from softwarp.solvers.partition import GPU_PATHS, SolverPath, choose_variant, free_ranges, thread_count
from softwarp.solvers.repeats import repeats_steps
from softwarp.solvers.second_order import stepper
from softwarp.solvers.system import System
from softwarp.solvers.workspace import workspace

Made = TypeVar("Made")

MOST_COUNTED = 16384  # worlds whose arrays are counted; more take memory in proportion
SURE = 0.02  # share of free memory up to which declared arrays are so few that all others fit as well


@dataclass(frozen=True)
class Footprint:
    """Memory of a simulation.

    Attributes:
        num_worlds: Worlds.
        device: Where they are.
        total: Bytes of all arrays that grow with the number of worlds: states with the copy that ``reset`` returns to,
            commands, parameters and the solver's arrays. Code, and what worlds share, come on top.
        free: Bytes that are free on the device now.
        fixed: Those of ``total`` that more worlds would not add to: workspaces that worlds on a CPU use in turns.
    """

    num_worlds: int
    device: str
    total: int
    free: int
    fixed: int = 0

    @property
    def per_world(self) -> float:
        """Bytes of a world."""
        return self.total / self.num_worlds

    @property
    def most_worlds(self) -> int:
        """Worlds that fit into what is free, in proportion."""
        return self.fitting(self.free)

    def fitting(self, free: int) -> int:
        """Worlds that fit into so many bytes, in proportion."""
        return int(max(free - self.fixed, 0) * self.num_worlds // (self.total - self.fixed))

    def __str__(self) -> str:
        taken, each, free = (memory.readable(value) for value in (self.total, self.per_world, self.free))
        return (
            f"{self.num_worlds} worlds take {taken}, {each} each; {free} are free on {self.device}: "
            f"{self.most_worlds} worlds fit"
        )


def footprint(
    model: Model, path: SolverPath = "auto", threads: int | None = None, options: Options | None = None
) -> Footprint:
    """Memory that ``Simulation`` takes for a model.

    Args:
        model: Scene, with its number of worlds and device.
        path: ``solver_path`` of the simulation.
        threads: Its CPU threads.
        options: Its solver options.
    """
    worlds_asked, device = model.num_worlds, model.device
    model = replace(model, num_worlds=min(worlds_asked, MOST_COUNTED))
    variant = choose_variant(model, path)
    options = options or Options(gpu_path=path if path in GPU_PATHS else "auto")
    with memory.counting() as bill:
        containers: list[Any] = [create(kind, model) for kind in (State, Control)]
        bill.total *= 2  # what ``reset`` returns to
        containers.append(create(Parameters, model))
        index = upload(model.symbolic, model.device)

        def taken(worlds: int, pool: memory.Pool) -> int:
            before = bill.total
            state, control, parameters = (worlds_slice(part, 0, worlds) for part in containers)
            with memory.pooled(pool):
                stepper(System(model, index, variant, state, control, parameters, options), h=1.0)
            added, bill.total = bill.total - before, before
            return added

        ranges, is_free = free_ranges(variant, model, threads, repeats_steps(model, options))
        sizes, fixed = [end - begin for begin, end in ranges], 0
        turns = len(sizes) if is_free else thread_count(threads)
        first, later = Counter(sizes[:turns]), Counter(sizes[turns:])
        for worlds in first | later:
            pool = memory.Pool()
            whole = taken(worlds, pool)
            own = taken(worlds, pool) if later else 0  # what is not shared by shards in turns
            bill.total += first[worlds] * whole + later[worlds] * own
            fixed += first[worlds] * (whole - own) if later else 0
    total = fixed + (bill.total - fixed) * worlds_asked // model.num_worlds
    return Footprint(worlds_asked, device, total, memory.free_bytes(device), fixed)


def require_room(
    model: Model,
    path: SolverPath = "auto",
    threads: int | None = None,
    options: Options | None = None,
    *,
    reclaim: Callable[[], None],
) -> None:
    """Refuse a model whose worlds do not fit on their device.

    Args:
        model: As for ``footprint``.
        path: Likewise.
        threads: Likewise.
        options: Likewise.
        reclaim: Gives caches back to the device; called before a model is refused.

    Raises:
        MemoryError: With the bytes that are needed and free, and the number of worlds that fit.
    """
    if _declared(model) < SURE * memory.free_bytes(model.device):
        return

    def taken(worlds: int) -> Footprint:
        return footprint(replace(model, num_worlds=worlds), path, threads, options)

    def most(free: int) -> int:
        worlds, told = model.num_worlds, needed
        while worlds and told.total > free:  # worlds are padded to packs, and paths depend on their number
            worlds = min(worlds - 1, told.fitting(free))
            told = taken(worlds) if worlds else told
        return worlds

    needed = taken(model.num_worlds)
    memory.require(needed.total, model.device, "this scene", model.num_worlds, "worlds", reclaim, most)


def with_room(make: Callable[[], Made], thing: str, model: Model, reclaim: Callable[[], None]) -> Made:
    """What ``make`` makes, a workspace for worlds of ``model`` that exist, if there is room for it.

    Args:
        make: Allocates by ``memory.zeros``; called once more, to count, where memory may be short.
        thing: What it is for, for the message.
        model: Scene.
        reclaim: Gives caches back to the device; called before anything is refused.

    Raises:
        MemoryError: If it does not fit on the device.
    """
    if _declared(model) >= SURE * memory.free_bytes(model.device):
        with memory.counting() as bill:
            make()
        memory.require(bill.total, model.device, thing, model.num_worlds, "worlds", reclaim)
    return make()


def _declared(model: Model) -> int:
    """Bytes of the workspace and of the linear solver's factors: cheap to tell, and a fair part of the whole."""
    items = workspace.counts(model, exact=False)
    rows = sum(items[about.item] * about.width for about in workspace.declared().values())
    rows += 9 * int(model.symbolic.block_count)
    return rows * (8 if model.precision == "float64" else 4) * model.num_worlds
