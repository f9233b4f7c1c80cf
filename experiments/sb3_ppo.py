"""Stable-Baselines3 PPO on a batched softwarp environment.

    python -m experiments.sb3_ppo CartStem --steps 200000 --worlds 64 --gamma 0.99 --out cart_stem.zip
    python -m experiments.sb3_ppo Trunk --steps 200000 --set mesh=coarse

The adapter below is all that Stable-Baselines3 needs: one VecEnv around the native VectorEnv, no processes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

import softwarp.gym  # registers the ids
from softwarp.envs import registry
from softwarp.io.atomic import atomic_path, prove_writable

Array = NDArray[Any]

MINIBATCHES = 4


class SoftVecEnv(VecEnv):
    """A native vector environment as Stable-Baselines3 sees it.

    Args:
        env: Made by ``gymnasium.make_vec`` with automatic reset in the same step.
    """

    def __init__(self, env: softwarp.gym.VectorEnv) -> None:
        self.env = env
        self.render_mode = env.render_mode
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: Array = np.empty(0)

    def reset(self) -> Array:
        """First observations of all worlds; seeds given by ``seed`` are used once."""
        seeds = None if self._seeds[0] is None else [int(seed) for seed in self._seeds if seed is not None]
        observation, _ = self.env.reset(seed=seeds)
        self._reset_seeds()
        return observation

    def step_async(self, actions: Array) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all worlds; infos are filled in for those whose episode ended."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        done = terminated | truncated
        for world in np.flatnonzero(done):
            infos[world] = {
                "terminal_observation": info["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world] and not terminated[world]),
                "is_success": bool(info["final_info"]["success"][world]),
                "distance": float(info["final_info"]["distance"][world]),
            }
        return observation, reward, done, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_images(self) -> Sequence[Array | None]:
        """A picture of every world."""
        return self.env.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the vector environment, the same for every world."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the vector environment; worlds cannot differ."""
        if indices is not None:
            raise ValueError(f"set_attr({attr_name!r}): the worlds share one environment; leave indices out")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment once."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Worlds are never wrapped one by one."""
        return [False] * len(list(self._get_indices(indices)))


def train(args: argparse.Namespace) -> tuple[PPO, VecMonitor]:
    """Train for ``args.steps`` environment steps."""
    options: Any = OmegaConf.to_container(OmegaConf.from_dotlist(args.set))
    env = gymnasium.make_vec(registry.spec(args.env).gym_id, num_envs=args.worlds, device=args.device, **options)
    assert isinstance(env, softwarp.gym.VectorEnv)
    monitored = VecMonitor(SoftVecEnv(env), info_keywords=("is_success", "distance"))
    monitored.seed(args.seed)
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
