"""Worlds that a thread steps one after the other share a workspace, and never notice."""

from typing import Any

import pytest
import torch
import warp as wp

import softwarp as sw
from softwarp.model import memory
from softwarp.solvers import partition
from tests.contract import test_batch, test_batch_contact
from tests.contract.batch_checks import assert_same

PATHS = [
    pytest.param({"solver_path": "scalar"}, "float32", marks=pytest.mark.slow),
    ({"solver_path": "lanes"}, "float32"),
    pytest.param({"solver_path": "scalar"}, "float64", marks=pytest.mark.slow),
    pytest.param({"solver_path": "lanes", "integrator": "bdf2"}, "float32", marks=pytest.mark.slow),
    pytest.param({"solver_path": "lanes", "newton_iterations": 4}, "float32", marks=pytest.mark.slow),
]
each_path = pytest.mark.parametrize(("options", "precision"), PATHS)


@pytest.fixture(autouse=True)
def small_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache that a single pack does not fit into, so that each steps by itself."""
    monkeypatch.setattr(partition, "SHARD_BYTES", 1.0)


def packs(options: dict[str, Any], count: int) -> int:
    """Worlds of some packs, the last of which is not full."""
    return count if options["solver_path"] == "scalar" else 8 * count - 3


def workspaces(sim: sw.Simulation) -> int:
    return len({system.work.a.real.ptr for system in sim.systems})


@each_path
@pytest.mark.parametrize("threads", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_shared_workspace_changes_no_bit(options: dict[str, Any], precision: str, threads: int) -> None:
    """Soft bodies, rigid ones and a rod that fall on each other: equal to shards with workspaces of their own."""
    worlds = packs(options, 5)
    shared, apart = (test_batch_contact.build(worlds, options | {"threads": threads}, precision) for _ in range(2))
    apart.keep_solutions()
    assert len(shared.systems) == workspaces(apart) == 5
    assert workspaces(shared) == threads
    kept = [system.contact.detector.room.real.ptr for system in shared.systems if system.contact is not None]
    assert len(set(kept)) == 5  # what searches have found is each shard's own, for without it they start over
    for sim in (shared, apart):
        test_batch_contact.vary(sim, list(range(worlds)))
        test_batch_contact.run(sim, 40)
    assert int(shared.contact_count.max()) > 8
    everyone = list(range(worlds))
    assert_same(test_batch_contact.state(shared), test_batch_contact.state(apart), everyone, everyone)


@pytest.mark.parametrize("path", [pytest.param("scalar", marks=pytest.mark.slow), "lanes"])
def test_diverged_worlds_leave_nothing_to_the_next_pack(path: str) -> None:
    """All worlds of the first pack are NaN: they are told, and the packs that use its memory keep their bits."""
    options = {"solver_path": path, "threads": 1}
    worlds = packs(options, 3)
    bad = list(range(1 if path == "scalar" else 8))
    good = list(range(len(bad), worlds))
    clean, broken = (test_batch_contact.build(worlds, options) for _ in range(2))
    for sim in (clean, broken):
        test_batch_contact.vary(sim, list(range(worlds)))
        test_batch_contact.run(sim, 20)
    for _ in range(5):
        broken.node_x[bad] = float("nan")
        broken.body_twist[bad] = float("nan")
        for sim in (clean, broken):
            test_batch_contact.run(sim, 1)
        assert (broken.status[bad] == sw.Status.NONFINITE).all()
        assert_same(test_batch_contact.state(clean), test_batch_contact.state(broken), good, good)


@pytest.mark.parametrize("path", [pytest.param("scalar", marks=pytest.mark.slow), "lanes"])
def test_measures_of_all_worlds_are_their_own(path: str) -> None:
    """Forces, masses, stiffness and reactions of worlds with a shared workspace equal those with one of their own."""
    options = {"solver_path": path, "threads": 1}
    worlds = packs(options, 3)
    shared, apart = (test_batch.build(worlds, options, "float32") for _ in range(2))
    apart.keep_solutions()
    assert (workspaces(shared), workspaces(apart)) == (1, 3)
    for sim in (shared, apart):
        test_batch.run(sim, list(range(worlds)), 5)
    assert not torch.equal(shared.node_x[0], shared.node_x[-1])
    assert torch.equal(shared.internal_force(), apart.internal_force())
    assert torch.equal(shared.mass, apart.mass)
    assert torch.equal(shared.reactions().node, apart.reactions().node)
    for world in (0, worlds - 1):
        assert (shared.stiffness_matrix(world) != apart.stiffness_matrix(world)).nnz == 0
        assert (shared.mass_matrix(world) != apart.mass_matrix(world)).nnz == 0


def test_pool_gives_owners_the_same_arrays_and_never_one_twice() -> None:
    """The second owner gets the first one's arrays or parts of them, and its own where these do not fit."""
    pool = memory.Pool()

    def owner(*shapes: tuple[int, ...]) -> list[Any]:
        with memory.pooled(pool):
            return [memory.zeros(shape, wp.float32, "cpu") for shape in shapes]

    first, part, wide = owner((4, 3), (4, 3)), owner((2, 3), (4, 3)), owner((5, 3), (4, 2), (1, 1))
    assert part[0].ptr == first[0].ptr and part[0].shape == (2, 3)
    assert part[1].ptr == first[1].ptr
    assert len({array.ptr for array in (*first, *wide)}) == 5
    first[0].fill_(1.0)
    assert (part[0].numpy() == 1.0).all()
    assert [array.shape for array in owner((3, 0, 8)) + owner((2, 0, 8))] == [(3, 0, 8), (2, 0, 8)]  # no rows
    assert memory.zeros((4, 3), wp.float32, "cpu").ptr not in {array.ptr for array in first}
