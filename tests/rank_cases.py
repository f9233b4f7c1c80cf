"""What each rank does in tests of several: functions of this file, run by processes set up as torchrun's are."""

import json
import os
import signal
import socket
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from softwarp.policies.policy import NetworkConfig
from softwarp.training import ranks as company
from softwarp.training.algorithms import ALGORITHMS, make_algorithm
from softwarp.training.checkpoints import CheckpointFolder
from softwarp.training.cloning import clone
from softwarp.training.demonstrations import Demonstrations
from softwarp.training.evaluation import run_episodes
from softwarp.training.logs import LoggerConfig
from softwarp.training.loop import RunConfig, _Session, portion, train
from softwarp.training.options import CloningConfig, PPOConfig, SACConfig
from softwarp.training.ranks import Ranks
from tests.unit.training.reach import PointReach

WORLDS, UPDATE = 8, 64  # of a rank, and its steps of an update
SMALL_PPO: dict[str, Any] = {"horizon": 8, "epochs": 2, "minibatches": 2}
SMALL_SAC: dict[str, Any] = {"horizon": 8, "batch": 32, "warmup_steps": 100, "capacity": 400, "update_ratio": 0.0625}
KINDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "ppo": (PPOConfig(**SMALL_PPO, schedule="adaptive"), {}),
    "avec": (PPOConfig(**SMALL_PPO, critic_bias=0.0, scale_rewards=True), {}),
    "memory": (PPOConfig(**SMALL_PPO, warmup_updates=1), {"recurrent": 4}),
    "sac": (SACConfig(**SMALL_SAC), {}),
    "sac_avec": (SACConfig(**SMALL_SAC, critic_bias=0.3), {}),
}


@dataclass
class Process:
    """A rank, and where its result comes out."""

    process: Any
    result: Connection

    def finish(self, patience: float = 120.0) -> Any:
        """What it returns."""
        assert self.result.poll(patience), "a rank has told nothing in time"
        told = self.result.recv()
        self.process.join(patience)
        assert self.process.exitcode == 0
        return told


def start(task: str, size: int, *arguments: object) -> list[Process]:
    """``size`` ranks that call a function of this file, forked from a process that has loaded it."""
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    found = []
    for rank in range(size):
        told = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": size, "LOCAL_WORLD_SIZE": size}
        told |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        ours, theirs = context.Pipe(duplex=False)
        given = (task, {key: str(value) for key, value in told.items()}, theirs, [str(item) for item in arguments])
        process = context.Process(target=main, args=given, daemon=True)  # type: ignore[attr-defined]
        process.start()
        theirs.close()
        found.append(Process(process, ours))
    return found


def finish(processes: list[Process]) -> list[Any]:
    """What the ranks return; all must end well."""
    return [process.finish() for process in processes]


def main(task: str, environment: dict[str, str], result: Connection, arguments: list[str]) -> None:
    """One rank."""
    os.environ |= environment
    torch.set_num_threads(1)
    ranks = company.join()
    told = {"compare": compare, "run": run, "run_until_lost": run_until_lost}[task](ranks, *arguments)
    result.send(told)
    if "lost" not in told:
        ranks.close()


def compare(ranks: Ranks) -> dict[str, dict[str, float]]:
    """Largest differences of ranks from one process that has all worlds, kind by kind."""
    told = {kind: compare_ppo(ranks, kind) for kind in ("ppo", "avec", "memory")}
    told |= {kind: compare_sac(ranks, kind) for kind in ("sac", "sac_avec")}
    return told | {"cloning": compare_cloning(ranks)}


def make(ranks: Ranks, kind: str, worlds: int, seed: int) -> Any:
    torch.manual_seed(seed)
    config, network = KINDS[kind]
    return make_algorithm(PointReach(worlds, seed=seed), NetworkConfig(hidden=[16], **network), config, ranks)


def gathered(ranks: Ranks, data: Any) -> Any:
    """Rows of all ranks' data, in their order."""
    parts = ranks.exchange(data.to_dict())
    return torch.cat([TensorDict(part, data.shape) for part in parts])


def gap(one: torch.Tensor, other: torch.Tensor) -> float:
    """Largest difference, relative to the largest entry."""
    return float((one - other).abs().max() / other.abs().max().clamp_min(1e-12))


def gradients(algorithm: Any) -> torch.Tensor:
    """All of them, end to end."""
    found = algorithm.averaged if hasattr(algorithm, "averaged") else algorithm.parameters
    return torch.cat([item.grad.reshape(-1) for item in found if item.grad is not None])


def norms(one: Any, other: Any) -> float:
    """Largest difference of the statistics of two algorithms."""
    pairs = [(one.policy.observation_norm, other.policy.observation_norm)]
    pairs += [(one.policy.value_norm, other.policy.value_norm)] if hasattr(one.policy, "value_norm") else []
    pairs += [(one.rollout.return_norm, other.rollout.return_norm)]
    return max(gap(getattr(a, name), getattr(b, name)) for a, b in pairs for name in ("mean", "var", "count"))


def compare_ppo(ranks: Ranks, kind: str) -> dict[str, float]:
    many = make(ranks, kind, WORLDS, ranks.seed(0))
    alone = make(company.ALONE, kind, WORLDS * ranks.size, 5)
    alone.policy.load_state_dict(many.policy.state_dict())
    for _ in range(2):  # the statistics of all that came before count
        many.collect()
        many.policy.observation_norm.update(many.rollout.buffer["observation"], ranks.gather)
    alone.policy.load_state_dict(many.policy.state_dict())
    alone.rollout.return_norm.load_state_dict(many.rollout.return_norm.state_dict())
    batch = many.rollout.collect().clone()
    alone.rollout.return_norm.update(
        gathered(ranks, TensorDict({"r": many.rollout._returns}, many.rollout._returns.shape))["r"]
    )
    whole = gathered(ranks, batch)
    own, all_of_them = many.prepare(batch), alone.prepare(whole)
    half = len(own) // 2
    rows = torch.cat([torch.arange(half) + rank * len(own) for rank in range(ranks.size)])
    if kind == "memory":  # beyond the updates in which the actor stands still
        many.updates = alone.updates = 1
    told = many.differentiate(many._with_features(own[:half]))
    alone_told = alone.differentiate(alone._with_features(all_of_them[rows]))
    many.policy.observation_norm.update(own["raw"], ranks.gather)
    alone.policy.observation_norm.update(all_of_them["raw"])
    return {
        "gradient": gap(gradients(many), gradients(alone)),
        "norm": norms(many, alone),
        "kl": abs(float(told["kl"] - alone_told["kl"])),
    }


def compare_sac(ranks: Ranks, kind: str) -> dict[str, float]:
    many = make(ranks, kind, WORLDS, ranks.seed(0))
    alone = make(company.ALONE, kind, WORLDS * ranks.size, 5)
    for _ in range(3):
        many.collect()
    alone.policy.load_state_dict(many.policy.state_dict())
    alone.loss.load_state_dict(many.loss.state_dict())
    alone.rollout.return_norm.load_state_dict(many.rollout.return_norm.state_dict())
    seen = gathered(ranks, many.collect())
    alone.policy.observation_norm.update(seen["observation"])
    alone.rollout.return_norm.load_state_dict(many.rollout.return_norm.state_dict())
    own = many._replayed()
    whole = gathered(ranks, own)
    draw = torch.randn(ranks.size * len(own), 2, generator=torch.Generator().manual_seed(3))
    share = draw.chunk(ranks.size)[ranks.rank]
    with same_draws(share):
        many.differentiate(own)
    with same_draws(draw):
        alone.differentiate(whole)
    found = {"gradient": gap(gradients(many), gradients(alone)), "norm": norms(many, alone)}
    if many.config.critic_bias < 1.0:  # it is put back
        found["shift"] = gap(many.loss.mean_error, alone.loss.mean_error)
    return found


class same_draws:
    """Actions are drawn with given numbers, so that a part of a batch and the whole draw the same."""

    def __init__(self, numbers: torch.Tensor) -> None:
        self.numbers = numbers

    def __enter__(self) -> None:
        self.original = torch.distributions.normal._standard_normal
        numbers = self.numbers

        def draw(shape: Any, dtype: Any, device: Any) -> torch.Tensor:
            return numbers.expand(shape)

        torch.distributions.normal._standard_normal = draw

    def __exit__(self, *error: object) -> None:
        torch.distributions.normal._standard_normal = self.original


def compare_cloning(ranks: Ranks) -> dict[str, float]:
    """A clone of several ranks against one of the same minibatches, after some epochs."""
    generator = torch.Generator().manual_seed(0)
    observation = torch.randn(130, 4, generator=generator)
    action = (observation[:, 2:] - observation[:, :2]).clamp(-1.0, 1.0)
    episode = torch.arange(130) // 10
    ends = torch.zeros(13)
    shown = Demonstrations(observation, action, episode, ends, ends.bool(), ends, {})
    config = CloningConfig(path="-", epochs=4, batch=25)
    policies = []
    for company_of in (ranks, company.ALONE):
        policy = make(company.ALONE, "ppo", WORLDS, 0).policy
        torch.manual_seed(0 if company_of.size == 1 else ranks.rank)  # the order is rank 0's
        clone(policy, shown, config, company_of)
        policies.append(policy)
    found = [torch.cat([item.detach().reshape(-1) for item in policy.actor.parameters()]) for policy in policies]
    return {"weights": gap(*found)}


def run(ranks: Ranks, folder: str, kind: str, updates: str, events: str = "{}") -> dict[str, Any]:
    """Train until ``updates`` are made, going on with what the folder holds.

    Args:
        ranks: That train.
        folder: Run folder.
        kind: Of the algorithm.
        updates: How many, of this number of ranks.
        events: JSON: ``{"kill": [rank, look], "stop": [rank, look]}``, at which look at the clock a rank is killed or
            gets a signal; ``"every": s`` between checkpoints.
    """
    told = json.loads(events)
    checkpoints = CheckpointFolder(Path(folder) / "checkpoints", keep=3)
    content = checkpoints.load_latest() if ranks.is_first and checkpoints.files() else None
    goes_on = bool(ranks.told(content is not None))
    config, _ = KINDS[kind]
    algorithm = make(ranks, kind, WORLDS, ranks.seed(12345 if goes_on else 0))
    own = ALGORITHMS[config.name][1].own
    if goes_on and ranks.size == 1 and content is not None and "others" not in content:
        resume: dict[str, Any] | None = content
    else:
        resume = portion(content, ranks, own) if goes_on else None
    looks, look = 0, _Session.pulse

    def watched(self: _Session, overtime: float = 0.0) -> None:
        nonlocal looks
        looks += 1
        for what, number in (("kill", signal.SIGKILL), ("stop", signal.SIGTERM)):
            if told.get(what) == [ranks.rank, looks]:
                os.kill(os.getpid(), number)
        look(self, overtime)

    _Session.pulse = watched  # type: ignore[method-assign]
    held_out = PointReach(8, seed=99)
    done = 0 if resume is None else int(resume["counters"]["steps"])
    total = int(updates) * UPDATE * ranks.size if "total" not in told else int(told["total"])
    outcome = train(
        algorithm,
        lambda policy: run_episodes(held_out, policy, seed=5),
        Path(folder),
        RunConfig(total_steps=total, evaluations=2, checkpoint_seconds=float(told.get("every", 0.0))),
        logger=LoggerConfig(tensorboard=False, progress=False),
        settings={},
        resume=resume,
    )
    weights = torch.cat([item.detach().reshape(-1).double() for item in algorithm.policy.parameters()])
    state = [weights, algorithm.policy.observation_norm.mean, algorithm.rollout.now["observation"].reshape(-1)]
    return {
        "weights": state[0].tolist(),
        "norm": state[1].tolist(),
        "worlds": state[2].tolist(),
        "draw": float(torch.rand(())),
        "signal": outcome.signal,
        "begun": outcome.begun,
        "steps": outcome.counters.steps,
        "resumed_at": done,
        "rate": algorithm.learning_rate,
        "looks": looks,
    }


def run_until_lost(ranks: Ranks, *arguments: str) -> dict[str, Any]:
    """``run``, where others are killed: tells how this rank hears of it."""
    try:
        return run(ranks, *arguments)
    except company.RankLost as error:
        return {"lost": str(error)}
