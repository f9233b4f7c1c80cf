"""What the batch tests of all kinds of scenes have in common; every comparison is of bits."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch

import softwarp as sw

State = dict[str, torch.Tensor]


def assert_same(first: State, second: State, rows: list[int], others: list[int]) -> None:
    """Worlds ``rows`` of one run equal worlds ``others`` of another, bit for bit."""
    for name in first:
        assert torch.equal(first[name][rows], second[name][others]), f"{name} differs"


@dataclass(frozen=True)
class Play:
    """A scene of individuals: worlds that differ by parameters and commands.

    Attributes:
        build: Simulation of a number of worlds with options, precision and device.
        characterise: Gives each world the parameters of an individual.
        run: Takes individuals through some steps from step ``start``.
        state: Copies of what is compared.
    """

    build: Callable[..., sw.Simulation]
    characterise: Callable[[sw.Simulation, list[int]], None]
    run: Callable[..., None]
    state: Callable[[sw.Simulation], State]

    def check_threads(self, path: str, steps: int) -> None:
        """Worlds spread over other numbers of threads give the same bits."""
        identity = list(range(19))
        sims = [self.build(19, {"solver_path": path, "threads": count}) for count in (1, 3)]
        for sim in sims:
            self.characterise(sim, identity)
            self.run(sim, identity, steps)
        assert_same(self.state(sims[0]), self.state(sims[1]), identity, identity)

    def check_snapshot(self, options: dict[str, Any], precision: str, device: str, steps: int) -> None:
        """Save, go on, restore, go on again: the same; also from one world into another place of another batch."""
        identity = [0, 1, 2, 3, 4]
        sim = self.build(5, options, precision, device)
        self.characterise(sim, identity)
        self.run(sim, identity, steps)
        saved = sim.snapshot()
        self.run(sim, identity, steps, start=steps)
        first = self.state(sim)
        sim.restore(saved)
        self.run(sim, identity, steps, start=steps)
        assert_same(first, self.state(sim), identity, identity)
        other = self.build(3, options, precision, device)
        self.run(other, [7, 8, 9], 5)
        one = sw.Snapshot(saved.fingerprint, saved.precision, {key: value[3:4] for key, value in saved.arrays.items()})
        other.restore(one, [1])
        self.run(other, [7, 3, 9], steps, start=steps)
        assert_same(first, self.state(other), [3], [1])

    def check_poisoned(
        self,
        options: dict[str, Any],
        poison: Callable[[sw.Simulation], object],
        steps: int,
        kept: tuple[str, ...],
        finite: tuple[str, ...] = (),
    ) -> None:
        """World 1 of nine takes a NaN: it says so and keeps its last good state; the others keep their bits."""
        sim, start, given, after = _nine_worlds(self, tuple(options.items()), steps)
        sim.restore(start)
        for name, value in given.items():
            sim.params.tensors()[name].copy_(value)
        before = self.state(sim)
        poison(sim)
        sim.step()
        others = [0, *range(2, 9)]
        now = self.state(sim)
        assert_same(now, after, others, others)
        assert int(now["status"][1]) == sw.Status.NONFINITE
        for name in kept:
            assert torch.equal(now[name][1], before[name][1]), name
        for name in finite:
            assert bool(torch.isfinite(now[name]).all()), name

    def check_reset(self, options: dict[str, Any], precision: str, device: str, steps: int) -> None:
        """Worlds that are reset start over, to the bit; the others do not notice."""
        identity = [0, 1, 2, 3]
        sims = [self.build(4, options, precision, device) for _ in range(2)]
        for sim in sims:
            self.characterise(sim, identity)
            self.run(sim, identity, steps)
        sims[0].reset(torch.tensor([False, True, False, True], device=sims[0].status.device))
        self.run(sims[0], identity, steps)  # worlds 1 and 3 go through all steps again
        fresh = self.build(4, options, precision, device)
        self.characterise(fresh, identity)
        self.run(fresh, identity, steps)
        assert_same(self.state(fresh), self.state(sims[0]), [1, 3], [1, 3])
        self.run(sims[1], identity, steps)
        assert_same(self.state(sims[1]), self.state(sims[0]), [0, 2], [0, 2])


@cache
def _nine_worlds(
    play: Play, options: tuple[tuple[str, Any], ...], steps: int
) -> tuple[sw.Simulation, sw.Snapshot, State, State]:
    """For all poisons: a simulation, what takes it and its parameters to where it was, and what one more step gives."""
    sim, identity = play.build(9, dict(options)), list(range(9))
    play.characterise(sim, identity)
    play.run(sim, identity, steps)
    start, given = sim.snapshot(), {name: value.clone() for name, value in sim.params.tensors().items()}
    sim.step()
    return sim, start, given, play.state(sim)
