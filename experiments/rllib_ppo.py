"""RLlib's PPO on a batched softwarp environment, in one process. Needs the extra ``rllib``.

    python -m experiments.rllib_ppo softwarp/CartStem-v0 --steps 200000 --gamma 0.99

RLlib's new stack takes Gymnasium's vector environments that reset by the next step. With ``--runners N`` as many
processes step ``--worlds`` worlds each; the prefix of the id has them import softwarp.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence

os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # what Ray is going to do, without its warning

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

MINIBATCHES = 4


def train(args: argparse.Namespace) -> float:
    """Train for ``args.steps`` environment steps or one update more; returns the last mean return."""
    batch = args.worlds * args.horizon * max(1, args.runners)
    config = (
        PPOConfig()
        .environment(f"softwarp:{args.id}", env_config={"autoreset_mode": "NextStep"})
        .env_runners(
            num_env_runners=args.runners,
            num_envs_per_env_runner=args.worlds,
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length=args.horizon,
        )
        .learners(num_learners=0)
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64], fcnet_activation="tanh"))
        .training(
            train_batch_size_per_learner=batch,
            minibatch_size=batch // MINIBATCHES,
            num_epochs=5,
            gamma=args.gamma,
            lr=args.learning_rate,
            lambda_=0.95,
            vf_clip_param=1e4,  # of squared errors: RLlib's 10 would silence the critic's gradient, returns reach 80
            grad_clip=0.5,
        )
        .debugging(seed=args.seed, log_level="ERROR")
    )
    algorithm = config.build_algo()
    steps, begun, returned = 0, time.perf_counter(), float("nan")
    while steps < args.steps:
        told = algorithm.train()["env_runners"]
        steps, returned = int(told["num_env_steps_sampled_lifetime"]), told.get("episode_return_mean", float("nan"))
    seconds = time.perf_counter() - begun
    print(f"{steps} steps in {seconds:.1f} s, {steps / seconds:.0f} steps/s, return {returned:.2f}")
    algorithm.stop()
    return float(returned)


def main(argv: Sequence[str] | None = None) -> float:
    """Read the command line and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("id", nargs="?", default="softwarp/CartStem-v0", help="Gymnasium id")
    parser.add_argument("--steps", type=int, default=200_000, help="environment steps over all worlds")
    parser.add_argument("--worlds", type=int, default=64, help="worlds that step together")
    parser.add_argument("--horizon", type=int, default=32, help="steps per world between updates")
    parser.add_argument("--runners", type=int, default=0, help="processes that step worlds; 0: this one")
    parser.add_argument("--gamma", type=float, default=0.99, help="discount")
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    ray.init(include_dashboard=False, num_cpus=max(2, args.runners + 1), log_to_driver=False, ignore_reinit_error=True)
    try:
        return train(args)
    finally:
        ray.shutdown()


if __name__ == "__main__":
    main()
