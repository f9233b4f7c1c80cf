"""Threads and forked processes: simulations in them work, with the bits that they have alone."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch
import warp as wp

import softwarp as sw
from softwarp import threads
from softwarp.control import InverseController
from softwarp.envs import registry
from softwarp.render import RayCaster
from tests.contract import test_batch
from tests.thread_cases import SCENES, Bits, differing, rods, trunk

ROOT = Path(__file__).parents[2]
QUICK = ("trunk, large, lanes on two threads", "trunk, neo-Hookean", "rods", "contact", "cart and pole")
PATIENCE = 60.0  # s until a child counts as hanging


def run_in_threads(names: tuple[str, ...], count: int, each: int) -> list[str]:
    """What went wrong where each of some threads made and stepped simulations drawn from scenes."""
    alone = {name: SCENES[name]() for name in names}

    def work(seed: int) -> list[str]:
        drawn = random.Random(seed).choices(names, k=each)
        return [f"{name}: {wrong}" for name in drawn if (wrong := differing(alone[name], SCENES[name]()))]

    with ThreadPoolExecutor(count) as pool:
        return [line for lines in pool.map(work, range(count)) for line in lines]


def test_simulations_in_threads_are_those_alone() -> None:
    """8 threads x 3 simulations of mixed scenes, equal to the bit; the code before aborted or failed in every try."""
    assert run_in_threads(QUICK, 8, 3) == []


@pytest.mark.slow
def test_many_threads() -> None:
    """32 threads x 50 simulations of all scenes."""
    assert run_in_threads(tuple(SCENES), 32, 50) == []


@pytest.mark.cuda
def test_captures_beside_work_on_the_default_stream_of_a_gpu() -> None:
    """Threads make and step simulations while another launches on the stream that CUDA lets all others wait for."""
    expected, is_over = rods(3, device="cuda:0"), threading.Event()

    def keep_busy() -> int:
        x, turns = torch.ones(64, device="cuda:0"), 0
        while not is_over.is_set():
            x, turns = x.sin(), turns + 1
        return turns

    with ThreadPoolExecutor(5) as pool:
        busy = pool.submit(keep_busy)
        try:
            found = list(pool.map(lambda _: rods(3, device="cuda:0"), range(12)))
        finally:
            is_over.set()
    assert busy.result() > 100
    assert [wrong for bits in found if (wrong := differing(expected, bits))] == []


@pytest.mark.slow
def test_threads_with_an_empty_cache(tmp_path: Path) -> None:
    """8 threads that start at the same time in a process that has no kernels yet, neither loaded nor compiled."""
    program = (
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from tests.thread_cases import SCENES, differing\n"
        "names = [*SCENES] * 2\n"
        "with ThreadPoolExecutor(8) as pool:\n"
        "    found = list(pool.map(lambda name: SCENES[name](), names))\n"
        "wrong = [name for name, bits in zip(names, found) if differing(SCENES[name](), bits)]\n"
        "assert not wrong, wrong\n"
    )
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path), "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", program], check=True, env=environment)


def test_simulation_is_handed_from_thread_to_thread() -> None:
    """Made in one thread, stepped in others that have ended when the next begins: the steps of one thread."""
    expected = rods(1)
    made: list[sw.Simulation] = []

    def build() -> None:
        made.append(test_batch.build(8, {"threads": 2}))

    def advance() -> None:
        made[-1].step()

    for work in (build, *[advance] * 4):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    here = test_batch.build(8, {"threads": 2})
    for _ in range(4):
        here.step()
    assert torch.equal(made[0].node_x, here.node_x)
    assert differing(expected, rods(1)) == []


def test_steps_do_not_wait_for_other_threads() -> None:
    """From the third on steps go on while another thread compiles, which may take minutes."""
    sim = test_batch.build(8, {"threads": 2})
    for _ in range(2):
        sim.step()
    with ThreadPoolExecutor(1) as pool, threads.alone:
        pool.submit(sim.step, 3).result(timeout=PATIENCE)
    assert float(sim.time[0]) == pytest.approx(0.05)


def test_error_in_one_thread_waits_for_the_others() -> None:
    """Nobody goes on with worlds that other threads are still stepping; the same holds for an interrupt."""
    done: list[int] = []

    def work(shard: int) -> None:
        if shard == 0:
            raise ValueError("first")
        time.sleep(0.1)
        done.append(shard)

    with pytest.raises(ValueError, match="first"):
        threads.Workers(2).run(work, range(4))
    assert sorted(done) == [1, 2, 3]


class _Watched:
    """A lock that knows whether some thread has it."""

    def __init__(self) -> None:
        self._lock, self.depth = threading.RLock(), 0

    def acquire(self) -> None:
        self._lock.acquire()
        self.depth += 1

    def release(self) -> None:
        self.depth -= 1
        self._lock.release()


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Work with Warp that is done without a turn: launches, allocations, captures, new kernels."""
    lock, found = _Watched(), []
    monkeypatch.setattr(threads.alone, "lock", lock)

    def watch(owner: Any, name: str, counts: Callable[..., bool] = lambda **_: True) -> None:
        original = getattr(owner, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            if lock.depth == 0 and counts(**kwargs):
                frame = sys._getframe(1)
                found.append(f"{name} from {frame.f_code.co_filename}:{frame.f_lineno}")
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, call)

    watch(wp, "launch")
    watch(wp, "copy")
    watch(wp.array, "__init__", lambda ptr=None, **_: ptr is None)
    watch(wp.array, "zero_")
    watch(wp.array, "assign")
    watch(wp.ScopedCapture, "__enter__")
    watch(wp.Kernel, "__init__")
    yield found


def test_work_with_warp_is_done_in_turn(watched: list[str]) -> None:
    """Whatever is called, no thread builds kernels, allocates, launches or captures without a turn."""
    trunk("large", 1, newton_iterations=2)
    for name in ("rods", "contact", "static"):
        SCENES[name]()
    env = registry.make("CartStem", num_worlds=2, seed=0, render_width=32, render_height=24)
    env.rollout(3)
    env.restore(env.snapshot())
    env.render()
    sim = test_batch.build(2, {"newton_iterations": 2})
    sim.make_systems(1)
    sim.dt = 0.02
    for _ in range(3):
        sim.step()
    sim.reset()
    sim.refresh()
    sim.energy(), sim.momentum(), sim.node_stress(), sim.internal_force(), sim.stiffness_matrix()
    sim.tangent_product(torch.ones_like(sim.node_x)), sim.rod_resultants(), sim.kinetic_energy()
    RayCaster.for_model(sim.model, width=16, height=12, threads=2).draw(sim)
    control = InverseController(sim, [0])
    for _ in range(3):
        control.solve(sim.marker_x[:, 0])
    assert watched == []


def in_child(work: Callable[[], object]) -> int:
    """Exit code of a forked process: 0 if the work is done, 1 if it raises, -9 if it hangs."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            work()
            code = 0
        finally:
            if code:
                traceback.print_exc()
            os._exit(code)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        process, status = os.waitpid(child, os.WNOHANG)
        if process:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_forked_processes_go_on() -> None:
    """A child steps its copy of a simulation, makes new ones and calls torch, all with the bits of its parent.

    Before, it waited for ever for threads that it has not: those of the simulation and those of torch, which are
    started here by a large product.
    """
    count = torch.get_num_threads()
    torch.set_num_threads(2)
    product = torch.eye(800) @ torch.eye(800)
    sim = test_batch.build(16, {"threads": 2})
    for _ in range(3):
        sim.step()
    expected = sim.snapshot()
    sim.step()
    after, known = sim.node_x.clone(), rods(1)
    sim.restore(expected)

    def work() -> None:
        sim.step()
        assert torch.equal(sim.node_x, after)
        assert differing(known, rods(1)) == []
        assert torch.equal(torch.eye(800) @ torch.eye(800), product)

    try:
        assert in_child(work) == 0
    finally:
        torch.set_num_threads(count)


def test_forks_beside_busy_threads() -> None:
    """Whatever other threads build and capture at the moment of a fork, its child makes simulations."""
    known, is_over = rods(1), threading.Event()

    def churn() -> None:
        while not is_over.is_set():
            rods(1)

    def work() -> None:
        assert differing(known, rods(1)) == []

    busy = [threading.Thread(target=churn) for _ in range(2)]
    for thread in busy:
        thread.start()
    try:
        assert [in_child(work) for _ in range(3)] == [0, 0, 0]
    finally:
        is_over.set()
        for thread in busy:
            thread.join()


def test_asynchronous_environments_after_use() -> None:
    """Gymnasium's processes, started by fork after environments were used here, act as the environment here does."""
    options: dict[str, Any] = {"settle": False, "num_envs": 1}
    found: list[Bits] = []
    for mode, how in (("vector_entry_point", {}), ("async", {"vector_kwargs": {"context": "fork"}})):
        env = gymnasium.make_vec("softwarp/CartPole-v0", vectorization_mode=mode, **options, **how)
        observation, _ = env.reset(seed=[3] if mode == "async" else 3)
        env.action_space.seed(0)
        seen = [observation, *(env.step(env.action_space.sample())[0] for _ in range(3))]
        found.append({str(step): torch.as_tensor(value) for step, value in enumerate(seen)})
        env.close()
    assert differing(*found) == []


def test_gpu_is_refused_after_a_fork(monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU's driver does not survive a fork; the refusal says how to start processes instead."""
    monkeypatch.setattr(threads, "_is_inherited", True)
    with pytest.raises(RuntimeError, match=r"cuda:0.*forked.*spawn"):
        threads.check_gpu("cuda:0")
    monkeypatch.setattr(threads, "_is_inherited", False)
    threads.check_gpu("cuda:0")


def test_environments_step_beside_no_threads_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that wait for work would take the cores that worlds are stepped on; the caller has his number again."""
    count, told = torch.get_num_threads(), []
    env = registry.make("CartStem", num_worlds=2, seed=1)
    env.reset()
    measure = env.measure_distance
    monkeypatch.setattr(env, "measure_distance", lambda: (told.append(torch.get_num_threads()), measure())[1])
    torch.set_num_threads(2)
    try:
        env.step(env.rand_action())
        assert set(told) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(count)
