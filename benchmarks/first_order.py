"""SHAC beside PPO, and what gradients of environments cost.

    softwarp bench first_order                                      # Diamond, on a CPU
    softwarp bench first_order --env Diamond Trunk --device cuda:0 --worlds 256 --seeds 0 1 2 --seconds 10
    softwarp bench first_order --env BubbleMotion --horizon 4 --device cuda:0 --worlds 256

Told are milliseconds per sub-step of all worlds: of a plain step, of one that is kept for the gradient, and of its
backward pass, with factors kept and without. Then both algorithms train with their default settings (``gamma`` 0.97 for
both) for the same time, evaluations and compiling left out, and are judged on goals that training does not see. On a
CPU the time is that of the process on all its cores, so that other work on the machine does not count.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

import softwarp as sw
from softwarp.envs.gradients import EnvSteps
from softwarp.policies.policy import NetworkConfig
from softwarp.training.algorithms import make_algorithm
from softwarp.training.evaluation import run_episodes
from softwarp.training.options import AlgorithmConfig, PPOConfig, SHACConfig

from .timing import machine, save

GAMMA = 0.97
CONFIGS: dict[str, Callable[[int | None], AlgorithmConfig]] = {
    "shac": lambda horizon: SHACConfig(gamma=GAMMA, **({} if horizon is None else {"horizon": horizon})),
    "ppo": lambda _: PPOConfig(gamma=GAMMA, horizon=25),
}
NEEDED: dict[str, dict[str, Any]] = {"BubbleMotion": {"contact_passes": 0}}  # whose gradients keep factors
SPLIT = ("Trunk", "Diamond")  # have goals apart to be judged on
ACTIONS = 4  # of a timed window
HELD_OUT = 1_000_003  # seed of the goals to be judged on


def clock(device: str) -> float:
    """Seconds: of the wall on a GPU, whose work is waited for, of the process on a CPU."""
    if device == "cpu":
        return time.process_time()
    torch.cuda.synchronize()
    return time.perf_counter()


def time_steps(env: Any, device: str, repeats: int, *, factors: bool) -> dict[str, float]:
    """Least milliseconds per sub-step of all worlds."""
    steps = EnvSteps(env, ACTIONS, factors=factors)
    shape = (ACTIONS, env.num_worlds, env.action_size)
    samples = []
    for _ in range(repeats + 2):  # kernels compile, then graphs are recorded
        actions = (0.2 * torch.rand(shape, device=env.device)).requires_grad_()
        begin = clock(device)
        for action in actions.detach():
            env.step_and_reset(action)
        plain = clock(device)
        steps.begin()
        rewards = torch.stack([steps.step(action).reward for action in actions])
        kept = clock(device)
        rewards.sum().backward()
        samples.append((plain - begin, kept - plain, clock(device) - kept))
    count = ACTIONS * env.action_repeat
    told = (1e3 * min(column) / count for column in zip(*samples[2:], strict=True))
    return dict(zip(("plain_ms", "forward_ms", "backward_ms"), told, strict=True))


def train(
    env: Any, judge: Any, kind: str, device: str, seconds: float, looks: int, horizon: int | None
) -> dict[str, Any]:
    """Evaluations over time and samples."""
    algorithm = make_algorithm(env, NetworkConfig(), CONFIGS[kind](horizon))
    algorithm.update(0.0)  # compiles and records
    spent, started = 0.0, algorithm.rollout.steps
    rows: list[dict[str, float]] = []
    while spent < seconds:
        begin = clock(device)
        algorithm.update(min(spent / seconds, 1.0))
        spent += clock(device) - begin
        if spent * looks >= seconds * (len(rows) + 1):
            found = run_episodes(judge, algorithm.policy, seed=5).summary()
            row = {"seconds": spent, "steps": algorithm.rollout.steps}
            rows.append(row | {key: found[key] for key in ("return", "success", "distance")})
    return {"evaluations": rows, "first_steps": started, "failures": int(algorithm.rollout.failures)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Time, then train every algorithm with every seed."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench first_order", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", nargs="+", default=["Diamond"])
    parser.add_argument("--mesh", default="coarse", help="of all environments")
    parser.add_argument("--algo", nargs="+", default=list(CONFIGS), choices=list(CONFIGS))
    parser.add_argument("--device", default="cpu", help="of simulation and networks")
    parser.add_argument("--worlds", type=int, default=32)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of training; 0 only times steps")
    parser.add_argument("--horizon", type=int, help="actions that SHAC's gradients go through; 16 if left out")
    parser.add_argument("--looks", type=int, default=8, help="evaluations of each")
    parser.add_argument("--repeats", type=int, default=5, help="windows that are timed; 0 times none")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    args = parser.parse_args(arguments)
    records: list[dict[str, Any]] = []
    for name in args.env:
        options = {"device": args.device, "mesh": args.mesh} | NEEDED.get(name, {})
        common = machine(args.device) | {"env": name, "mesh": args.mesh, "worlds": args.worlds}
        if args.repeats:
            env = sw.make(name, num_worlds=args.worlds, seed=0, **options)
            env.reset()
            for factors in (True, False):
                times = time_steps(env, args.device, args.repeats, factors=factors)
                records.append(common | {"case": "steps", "factors": factors} | times)
                print(f"{name}, {'kept' if factors else 'found again'}: {times}", flush=True)
                save(records, args.json)
        split = {"goal_split": "eval"} if name in SPLIT else {}
        judge = sw.make(name, num_worlds=64, seed=HELD_OUT, **options, **split)
        for kind in args.algo if args.seconds else ():
            for seed in args.seeds:
                torch.manual_seed(seed)
                env = sw.make(name, num_worlds=args.worlds, seed=seed, **options)
                told = train(env, judge, kind, args.device, args.seconds, args.looks, args.horizon)
                records.append(common | {"case": "training", "algo": kind, "seed": seed} | told)
                for row in told["evaluations"]:
                    print(f"{name} {kind} seed {seed}: {row}", flush=True)
                save(records, args.json)
    return 0
