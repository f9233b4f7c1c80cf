"""Stable-Baselines3: a batch of worlds as one ``VecEnv``, without processes. Needs the extra ``sb3``.

from stable_baselines3 import PPO
from softwarp import sb3

PPO("MlpPolicy", sb3.make("CartStem", num_worlds=64)).learn(200_000)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from softwarp import gym
from softwarp.unpicklable import Unpicklable

try:
    from stable_baselines3.common.vec_env import VecEnv as Base
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
except ImportError as error:
    raise ImportError("softwarp.sb3 needs Stable-Baselines3: pip install 'softwarp[sb3]'") from error

Array = NDArray[Any]


def make(name: str, num_worlds: int = 1, *, device: str = "cpu", seed: int | None = None, **options: Any) -> VecEnv:
    """Make an environment for Stable-Baselines3.

    Args:
        name: A name of ``softwarp.envs.names()``.
        num_worlds: Worlds that step together.
        device: Where they are simulated.
        seed: World i draws from ``seed + i`` from the first reset on; None takes one from the operating system.
        **options: Fields of the environment's configuration, and ``render_mode``.
    """
    env = VecEnv(gym.VectorEnv(num_worlds, name, device=device, **options))
    if seed is not None:
        env.seed(seed)
    return env


class VecEnv(Unpicklable, Base, instead="send a function that makes it, lambda: softwarp.sb3.make(name, num_worlds)"):
    """A native vector environment as Stable-Baselines3 sees it.

    ``infos`` tell of worlds whose episode ended: ``terminal_observation``, ``TimeLimit.truncated``, ``is_success`` and
    the last ``distance`` [m]; ``VecMonitor(env, info_keywords=("is_success", "distance"))`` collects the last two.

    Args:
        env: ``gymnasium.make_vec("softwarp/...")`` with automatic reset in the same step, which is the default.

    Raises:
        ValueError: If it resets otherwise.
    """

    def __init__(self, env: gym.VectorEnv) -> None:
        if env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP:
            raise ValueError("softwarp.sb3: Stable-Baselines3 resets within the step; leave out autoreset_mode")
        self.env = env
        self.render_mode = env.render_mode
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions: Array = np.empty(0)

    def reset(self) -> Array:
        """First observations of all worlds; seeds given by ``seed`` are used once."""
        seeds = None if self._seeds[0] is None else [int(seed) for seed in self._seeds if seed is not None]
        observation, _ = self.env.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
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
