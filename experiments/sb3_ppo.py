"""Stable-Baselines3 PPO on a batched softwarp environment.

    python -m experiments.sb3_ppo CartStem --steps 200000 --worlds 64 --gamma 0.99 --out cart_stem.zip
    python -m experiments.sb3_ppo Trunk --steps 200000 --set mesh=coarse

``softwarp.sb3`` makes one VecEnv of all worlds, without processes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from omegaconf import OmegaConf
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from softwarp import sb3
from softwarp.io.atomic import atomic_path, prove_writable

MINIBATCHES = 4


def train(args: argparse.Namespace) -> tuple[PPO, VecMonitor]:
    """Train for ``args.steps`` environment steps."""
    options: Any = OmegaConf.to_container(OmegaConf.from_dotlist(args.set))
    env = sb3.make(args.env, args.worlds, device=args.device, seed=args.seed, **options)
    monitored = VecMonitor(env, info_keywords=("is_success", "distance"))
    batch = args.worlds * args.horizon
    is_discrete = isinstance(monitored.action_space, gymnasium.spaces.Discrete)
    model = PPO(
        "MlpPolicy",
        monitored,
        n_steps=args.horizon,
        batch_size=batch // MINIBATCHES,
        n_epochs=5,
        learning_rate=3e-4,
        gamma=args.gamma,
        gae_lambda=0.95,
        policy_kwargs={"net_arch": [128, 128]} | ({} if is_discrete else {"log_std_init": -0.7}),
        seed=args.seed,
        device="cpu",
        verbose=1,
    )
    start = time.perf_counter()
    model.learn(args.steps)
    seconds = time.perf_counter() - start
    print(f"{model.num_timesteps} steps in {seconds:.1f} s, {model.num_timesteps / seconds:.0f} steps/s")
    return model, monitored


def main(argv: Sequence[str] | None = None) -> None:
    """Train, report the last episodes, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", nargs="?", default="Trunk", help="name of the environment; softwarp list shows them")
    parser.add_argument("--steps", type=int, default=20_000, help="environment steps over all worlds")
    parser.add_argument("--worlds", type=int, default=32, help="worlds that step together")
    parser.add_argument("--horizon", type=int, default=64, help="steps per world between updates")
    parser.add_argument("--gamma", type=float, default=0.97, help="discount")
    parser.add_argument("--set", nargs="+", default=[], metavar="key=value", help="options of the environment")
    parser.add_argument("--device", default="cpu", help="device of the simulation, for example cuda:0")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="", help="where to save the model; not saved when empty")
    args = parser.parse_args(argv)
    if args.worlds * args.horizon < 2 * MINIBATCHES:
        parser.error(f"--worlds times --horizon must be at least {2 * MINIBATCHES}, got {args.worlds * args.horizon}")
    if args.out:
        prove_writable(args.out)
    model, env = train(args)
    episodes = list(model.ep_info_buffer or [])
    if episodes:
        distance = np.median([episode["distance"] for episode in episodes])
        success = np.mean([episode["is_success"] for episode in episodes])
        returned = np.mean([episode["r"] for episode in episodes])
        told = f"return {returned:.2f}, success {success:.2f}, median final distance {1e3 * distance:.1f} mm"
        print(f"last {len(episodes)} episodes: {told}")
    if args.out:
        with atomic_path(Path(args.out).with_suffix(".zip")) as scratch:
            model.save(scratch)
    env.close()


if __name__ == "__main__":
    main()
