"""What a batch takes is told before it is allocated, and what does not fit is refused with the number that does."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import warp as wp
from tensordict import TensorDict

import softwarp as sw
from softwarp import host, meshing
from softwarp.envs.scenes import cart_pole, catch_the_object, trunk
from softwarp.model import memory
from softwarp.solvers.footprint import footprint
from softwarp.training.replay import Replay
from tests import cases
from tests.contract.test_batch import held_arrays


def add_beam(builder: sw.ModelBuilder) -> None:
    mesh = meshing.box((0.2, 0.03, 0.03), (6, 2, 2))
    body = builder.add_tets(mesh, material=sw.NeoHookean(1e5, 0.4), density=1e3)
    builder.fix(body, nodes=cases.on_plane(mesh, 0, 0.0).nonzero()[0])


SCENES: dict[str, Callable[[sw.ModelBuilder], Any]] = {
    "beam": add_beam,
    "trunk": lambda builder: trunk.build_trunk_scene(trunk.TrunkSceneConfig(), builder),
    "joints": lambda builder: cart_pole.build_cart_pole_scene(cart_pole.CartPoleSceneConfig(), builder),
    "contact and chambers": lambda builder: catch_the_object.build_catch_scene(
        catch_the_object.CatchSceneConfig(), builder
    ),
}


def described(scene: str) -> sw.ModelBuilder:
    builder = sw.ModelBuilder()
    SCENES[scene](builder)
    return builder


def allocated(sim: sw.Simulation) -> int:
    """Bytes of all arrays with memory of their own that a simulation holds, besides those of its model."""
    kept = {array.ptr for _, array in held_arrays(sim.model, sim.model, set())}
    own: dict[int, int] = {}
    for _, array in held_arrays(sim, sim, set()):
        while getattr(array, "_owner", None) is not None:
            array = array._owner
        if isinstance(array, wp.array) and array.deleter is not None and array.ptr not in kept:
            own[array.ptr] = array.capacity
    return sum(own.values()) + sum(value.nbytes for _, value in sim._initial.values())


@pytest.mark.parametrize(
    ("scene", "worlds", "precision", "options"),
    [
        ("beam", 40, "float32", {}),
        ("beam", 3, "float64", {"threads": 1}),
        ("beam", 40, "float32", {"solver_path": "scalar", "threads": 3}),
        ("trunk", 40, "float32", {}),
        ("joints", 200, "float32", {}),
        ("contact and chambers", 40, "float32", {}),
    ],
)
def test_estimate_is_what_is_allocated(scene: str, worlds: int, precision: Any, options: dict[str, Any]) -> None:
    """The estimate and the arrays that a simulation then holds agree within 10 %."""
    model = described(scene).finalize(worlds, precision=precision)
    told = footprint(model, options.get("solver_path", "auto"), options.get("threads"))
    held = allocated(sw.Simulation(model, **options))
    assert told.total == pytest.approx(held, rel=0.1)
    assert told.per_world == told.total / worlds


@pytest.mark.cuda
@pytest.mark.parametrize("scene", ["beam", "trunk", "contact and chambers"])
@pytest.mark.parametrize("worlds", [512, 4096])
def test_estimate_is_what_a_gpu_gives(scene: str, worlds: int) -> None:
    """The same by what the device has free before and after, for both ways to factorise."""
    first = sw.Simulation(described(scene).finalize(worlds, "cuda:0"), dt=0.01)
    first.step()  # loads the kernels' code
    model = described(scene).finalize(worlds, "cuda:0")
    wp.synchronize()
    before = memory.free_bytes("cuda:0")
    sim = sw.Simulation(model, dt=0.01)
    wp.synchronize()
    taken = before - memory.free_bytes("cuda:0")
    assert footprint(model).total == pytest.approx(taken, rel=0.1, abs=2**26)  # pools grow by 32 MiB
    assert int(sim.status.max()) == sw.Status.OK
    assert first.num_worlds == worlds


@pytest.fixture
def small_machine(monkeypatch: pytest.MonkeyPatch) -> int:
    """A machine with 50 MiB."""
    monkeypatch.setattr(memory, "free_bytes", lambda device: 50 * 2**20)
    return 50 * 2**20


def test_batch_that_does_not_fit_is_refused(small_machine: int) -> None:
    """``finalize`` names bytes needed, bytes free and the number of worlds that fit, which then do."""
    builder = described("beam")
    told = builder.memory_estimate(100_000)
    with pytest.raises(
        MemoryError, match=r"this scene needs .* MiB for 100000 worlds, 50 MiB are free on cpu"
    ) as error:
        builder.finalize(100_000)
    fitting = int(re.search(r"(\d+) worlds fit", str(error.value))[1])
    assert 490 <= fitting == pytest.approx(told.most_worlds, rel=0.05)
    assert 0.95 * small_machine < builder.memory_estimate(fitting).total <= small_machine
    assert builder.finalize(fitting).num_worlds == fitting
    for too_many in (fitting + 16, 2**31 - 1):
        message = rf"for {too_many} worlds, 50 MiB are free on cpu; {fitting // 10}\d worlds fit"
        with pytest.raises(MemoryError, match=message):
            builder.finalize(too_many)


def test_nothing_is_allocated_before_the_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulation whose model was made when there was room asks again, before its first array."""
    model = described("beam").finalize(20_000)
    monkeypatch.setattr(memory, "free_bytes", lambda device: 2**24)
    sizes = []
    make = wp.zeros
    monkeypatch.setattr(wp, "zeros", lambda shape, *a, **k: sizes.append(shape) or make(shape, *a, **k))
    with pytest.raises(MemoryError, match="20000 worlds, 16 MiB are free"):
        sw.Simulation(model)
    assert all(0 in shape for shape in sizes)


def test_static_solve_asks_for_its_workspace(monkeypatch: pytest.MonkeyPatch) -> None:
    """``solve_static`` makes a second workspace, and refuses when there is no room for it."""
    sim = sw.Simulation(described("beam").finalize(64))
    monkeypatch.setattr(memory, "free_bytes", lambda device: 2**20)
    with pytest.raises(MemoryError, match=r"solve_static needs .* MiB for 64 worlds, 1 MiB are free"):
        sim.solve_static()


def test_buffers_that_do_not_fit_are_refused(small_machine: int) -> None:
    """A replay that is larger than the memory left says how many transitions fit."""
    example = TensorDict({"observation": torch.zeros(2, 256)}, [2])
    with pytest.raises(MemoryError, match=r"the replay needs .* for 1000000 transitions, 50 MiB .*; 51200 transitions"):
        Replay(1_000_000, example)
    assert Replay(1000, example).capacity == 1000


def test_counting_makes_nothing() -> None:
    """Arrays that are counted have shapes and strides; afterwards arrays have memory again."""
    with memory.counting() as bill:
        array = memory.zeros((1 << 20, 1 << 20), wp.float32, "cpu")
        memory.fill(array, 1.0)
        assert array[5:7].shape == (2, 1 << 20)
    assert bill.total == 4 << 40
    assert memory.zeros((3,), wp.float32, "cpu").numpy().tolist() == [0.0] * 3


def test_limits_of_containers(tmp_path: Path) -> None:
    """What a control group leaves: its limit less what is used and cannot be dropped; none without a limit."""
    files = {"memory.max": "1000", "memory.current": "700", "memory.stat": "anon 500\ninactive_file 150\n"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    assert host._left_in(tmp_path, "memory.max", "memory.current") == 450
    (tmp_path / "memory.max").write_text("max\n")
    assert host._left_in(tmp_path, "memory.max", "memory.current") == host.BOUNDLESS
    assert host._left_in(tmp_path / "none", "memory.max", "memory.current") == host.BOUNDLESS
    assert 0 < memory.free_bytes("cpu") < host.BOUNDLESS
