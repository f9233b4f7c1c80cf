"""Gymnasium: one world as ``Env``, many as a native ``VectorEnv``; both in NumPy.

Importing this file registers the ids (``softwarp/Trunk-v0`` ...) and loads Gymnasium, but not Torch; that happens when
an environment is made. Options of the environment's dataclass are keywords of ``gymnasium.make`` and ``make_vec``; one
that does not exist is refused with the ``TypeError`` of an unexpected keyword, by which clients know what to leave out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from softwarp import checks, notices
from softwarp.advice import nearest
from softwarp.envs import registry
from softwarp.unpicklable import Unpicklable

if TYPE_CHECKING:
    from torch import Tensor

    from softwarp.envs.base import SoftEnv
    from softwarp.view import Window

Array = NDArray[Any]

INFO_KEYS = ("success", "distance", "world_status")  # whether the goal is met, distance to it [m], softwarp.Status
MASK_KEY = "action_mask"  # discrete actions that are legal, int8 as ``Discrete.sample`` takes it, where tasks have it
_NUMBERS = (*INFO_KEYS, "reward", "terminated", "truncated", "done")
_KNOWN = ("observation", MASK_KEY, *_NUMBERS)  # what else there is are sensors, told in the infos
_UNLIMITED = 2**62  # steps
_METADATA = {"render_modes": ["rgb_array", "human"], "render_fps": 20}


def register(entry: registry.EnvSpec) -> None:
    """Register an environment with Gymnasium; doing so again changes nothing."""
    if entry.gym_id not in gymnasium.registry:
        gymnasium.register(
            entry.gym_id,
            entry_point="softwarp.gym:SingleEnv",
            vector_entry_point="softwarp.gym:VectorEnv",
            max_episode_steps=entry.max_episode_steps,
            kwargs={"name": entry.name},
        )


class SingleEnv(Unpicklable, gymnasium.Env[Array, Any]):
    """One world of a softwarp environment.

    Episodes end after the configuration's ``max_episode_steps``; those of ``gymnasium.make`` after its own limit, which
    a wrapper keeps.

    Args:
        name: A name of ``softwarp.envs.names()``.
        device: Where it is simulated.
        render_mode: ``"rgb_array"``, ``"human"``: in the browser and in real time, or None.
        **options: Fields of the environment's configuration.

    Raises:
        TypeError: If there is no such field.
        ValueError: If a value is not valid.
    """

    metadata = _METADATA

    def __init__(
        self, name: str = "Trunk", *, device: str = "cpu", render_mode: str | None = None, **options: Any
    ) -> None:
        self.render_mode = _check_render_mode(render_mode, self.metadata)
        self.env = _make(type(self).__name__, name, 1, device, options)
        self._name = name
        self._window: Window | None = None
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.env.control_dt)}
        self.observation_space, self.action_space = _spaces(self.env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Start an episode; a seed makes it and all that follow repeatable."""
        if seed is not None:
            checks.seed(seed, "reset: seed")
        super().reset(seed=seed)
        if seed is not None:
            self.env.seed_worlds([seed])
        if self.spec is not None:
            self.env.max_episode_steps = _UNLIMITED
        data = _to_numpy(self.env.reset())
        if self.render_mode == "human":
            self._window = _shown(self.env, self._window)
        return data["observation"][0], _single_info(data)

    def step(self, action: Any) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Simulate one action.

        Raises:
            ValueError: If the action is not in the action space's shape, not finite, or out of range.
        """
        data = _step(self.env, np.asarray(action)[None])
        if self._window is not None:
            self._window.after_action()
        flags = [bool(data[key][0]) for key in ("terminated", "truncated")]
        return data["observation"][0], float(data["reward"][0]), flags[0], flags[1], _single_info(data)

    def render(self) -> Array | None:
        """A picture (height, width, 3); None if pictures are in the browser or not asked for."""
        return self.env.render()[0] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the page in the browser; nothing else is open. May be called again."""
        _hide(self.env, self._window)
        self._window = None

    def way_out(self) -> str:
        """How such an environment is made elsewhere."""
        return (
            f"send a function that makes it, as AsyncVectorEnv takes: lambda: "
            f"gymnasium.make({registry.spec(self._name).gym_id!r}); env.unwrapped.env.config and "
            "env.unwrapped.env.snapshot() can be pickled"
        )


class VectorEnv(Unpicklable, gymnasium.vector.VectorEnv[Array, Array, Array]):
    """Worlds that step together, without wrappers or processes; what ends an episode does is Gymnasium's.

    autoreset_mode   a world whose episode has ended
    ``"SameStep"``   is reset in the same step: the returned observation is the new episode's first, the old one's last
                     is in ``info["final_obs"]``, its info in ``info["final_info"]``
    ``"NextStep"``   is reset by the next step, which ignores its action and returns the first observation, no reward
    ``"Disabled"``   has to be reset by ``reset(options={"reset_mask": mask})`` before the next step

    ``"SameStep"`` is the quickest. With ``"NextStep"`` the simulator takes worlds that begin back to where they were.

    Args:
        num_envs: Number of worlds.
        name: A name of ``softwarp.envs.names()``.
        device: Where they are simulated.
        render_mode: ``"rgb_array"``, ``"human"``: in the browser and in real time, or None.
        autoreset_mode: One of the table's, or Gymnasium's ``AutoresetMode``.
        **options: Fields of the environment's configuration, ``max_episode_steps`` among them.

    Raises:
        TypeError: If there is no such field.
        ValueError: If a value is not valid.
    """

    metadata = _METADATA

    def __init__(
        self,
        num_envs: int = 1,
        name: str = "Trunk",
        *,
        device: str = "cpu",
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
        **options: Any,
    ) -> None:
        self.render_mode = _check_render_mode(render_mode, self.metadata)
        if not isinstance(autoreset_mode, AutoresetMode):
            checks.choice(autoreset_mode, "autoreset_mode", [mode.value for mode in AutoresetMode])
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.env = _make(type(self).__name__, name, num_envs, device, options)
        self._name = name
        self._window: Window | None = None
        self.num_envs = num_envs
        self.metadata = self.metadata | {
            "render_fps": round(1.0 / self.env.control_dt),
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space, self.single_action_space = _spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._has_begun = False
        self._ended = np.zeros(num_envs, dtype=np.bool_)  # worlds that are yet to be reset

    def way_out(self) -> str:
        """How such an environment is made elsewhere."""
        return (
            f"send a function that makes it, lambda: gymnasium.make_vec({registry.spec(self._name).gym_id!r}, "
            f"num_envs={self.num_envs}); env.unwrapped.env.config and env.unwrapped.env.snapshot() can be pickled"
        )

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start episodes in all worlds, or where ``options["reset_mask"]``, bool (num_envs,), holds.

        Args:
            seed: World i is seeded with ``seed + i``, or with ``seed[i]`` if that is not None, and then draws what a
                ``SingleEnv`` with that seed draws. With a mask, only the worlds are seeded in which it holds.
            options: May hold ``reset_mask``.

        Returns:
            Observations of all worlds; infos of those that were reset.

        Raises:
            ValueError: If the mask or the number of seeds does not fit.
            ResetNeeded: If there is a mask before the first reset of all worlds.
        """
        if options is not None and not isinstance(options, Mapping):
            raise ValueError(checks.refusal("reset: options", "be a dictionary, which may hold reset_mask", options))
        seeds = [None] * self.num_envs if seed is None else self._seeds(seed)
        mask = (options or {}).get("reset_mask")
        if mask is not None and not self._has_begun:
            raise ResetNeeded("reset: reset_mask begins some worlds anew; call reset() for all of them first")
        chosen = np.ones(self.num_envs, dtype=np.bool_) if mask is None else self._check_mask(np.asarray(mask))
        super().reset(seed=seeds[0])
        self._seed_where(seeds, chosen)
        data = _to_numpy(self.env.reset()) if mask is None else self._reset_masked(chosen)
        self._has_begun = True
        if self.render_mode == "human":
            self._window = _shown(self.env, self._window)
        self._ended &= ~chosen
        return data["observation"], _vector_info(data, chosen)

    def _seeds(self, seed: int | Sequence[int | None]) -> list[int | None]:
        """A seed for each world, or None for one that goes on with its own."""
        if isinstance(seed, (int, np.integer)):
            return [checks.seed(seed, "reset: seed") + i for i in range(self.num_envs)]
        if not isinstance(seed, (Sequence, np.ndarray)) or isinstance(seed, str) or len(seed) != self.num_envs:
            raise ValueError(checks.refusal("reset: seed", f"be an integer, or {self.num_envs} of them", seed))
        return [None if entry is None else checks.seed(entry, "reset: seed") for entry in seed]

    def _seed_where(self, seeds: Sequence[int | None], chosen: Array) -> None:
        """Seed the chosen worlds that have a seed; the others go on with their draws."""
        import torch

        taken = chosen & np.array([seed is not None for seed in seeds])
        if not taken.any():
            return
        draws = [self.env.world_state[key] for key in ("seed", "stream", "episode")]
        before = [state.clone() for state in draws]
        self.env.seed_worlds([0 if seed is None else seed for seed in seeds])
        where = torch.from_numpy(taken).to(self.env.device)
        for state, old in zip(draws, before, strict=True):
            torch.where(where, state, old, out=state)

    def step(self, actions: Any) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Simulate one action in every world.

        Raises:
            ValueError: If an action is not in the action space's shape, not finite, or out of range.
            ResetNeeded: Before the first reset, and where an episode has ended that only the caller resets.
        """
        if not self._has_begun:
            raise ResetNeeded("step: there is no episode yet; call reset() first")
        begins = self._ended
        if self.autoreset_mode is AutoresetMode.DISABLED and begins.any():
            worlds = np.flatnonzero(begins).tolist()
            raise ResetNeeded(f"step: the episodes of worlds {worlds} have ended; reset(options={{'reset_mask': ...}})")
        data = self._begin_or_step(begins, np.asarray(actions))
        reward, terminated, truncated = data["reward"], data["terminated"], data["truncated"]
        done = terminated | truncated
        info: dict[str, Any] = {}
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = done
        elif done.any():
            final = np.full(self.num_envs, None, dtype=object)
            for world in np.flatnonzero(done):
                final[world] = data["observation"][world]
            info = {"final_obs": final, "_final_obs": done.copy(), "final_info": _vector_info(data, done)}
            info["_final_info"] = done.copy()
            data = self._reset_masked(done)
        everywhere = np.ones(self.num_envs, dtype=np.bool_)
        return data["observation"], reward, terminated, truncated, info | _vector_info(data, everywhere)

    def _begin_or_step(self, begins: Array, actions: Array) -> dict[str, Array]:
        """Begin an episode where ``begins`` holds, where actions do not matter, and simulate them elsewhere."""
        if not begins.any():
            return _step(self.env, actions)
        nowhere = np.zeros(self.num_envs, dtype=np.float32)
        if begins.all():
            return self._reset_masked(begins) | {"reward": nowhere}
        _form(self.env, actions)
        begun = self._reset_masked(begins)
        harmless = np.where(begins.reshape(-1, *[1] * (actions.ndim - 1)), np.zeros_like(actions), actions)
        data = _step(self.env, harmless, ~begins)
        data = {key: np.where(begins.reshape(-1, *[1] * (v.ndim - 1)), begun.get(key, v), v) for key, v in data.items()}
        return data | {"reward": np.where(begins, nowhere, data["reward"])}

    def _check_mask(self, mask: Array) -> Array:
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"reset_mask must be bool of shape ({self.num_envs},) with a True in it, got {mask.dtype} {mask.shape}"
            )
        return mask

    def _reset_masked(self, mask: Array) -> dict[str, Array]:
        """New episodes where the mask holds; all worlds' observations."""
        import torch

        return _to_numpy(self.env.reset_where(torch.from_numpy(mask).to(self.env.device)))

    def render(self) -> tuple[Array, ...] | None:
        """A picture (height, width, 3) of every world; None if pictures are in the browser or not asked for."""
        return tuple(self.env.render()) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Close the page in the browser; nothing else is open."""
        _hide(self.env, self._window)
        self._window = None


def _spaces(env: SoftEnv) -> tuple[spaces.Box, spaces.Space[Any]]:
    """Observation and action space of one world."""
    low, high = (bound.cpu().numpy() for bound in env.observation_bounds()["observation"])
    action = spaces.Discrete(env.action_count) if env.action_count else spaces.Box(-1.0, 1.0, (env.action_size,))
    return spaces.Box(low, high, dtype=np.float32), action


def _make(owner: str, name: str, num_worlds: int, device: str, options: dict[str, Any]) -> SoftEnv:
    """An environment of the table.

    Raises:
        TypeError: If there is no such option, in Python's words: TorchRL tries ``frameskip`` and reads them.
    """
    valid = [field.name for field in dataclasses.fields(registry.spec(name).config_class())]
    unknown = [key for key in options if key not in valid]
    if unknown:
        told = "; ".join(f"{key!r}: {nearest(key, valid)}" for key in unknown)
        raise TypeError(
            f"{owner}.__init__() got an unexpected keyword argument {unknown[0]!r}; environment {name!r} has no option "
            f"{', '.join(map(repr, unknown))}; {told}"
        )
    return registry.make(name, num_worlds=num_worlds, device=device, **options)


def _form(env: SoftEnv, action: Array) -> Tensor:
    """Actions as a tensor on the environment's device, of the right type and shape."""
    import torch

    kind, wanted = (np.integer, torch.int64) if env.action_count else (np.floating, torch.float32)
    if not np.issubdtype(action.dtype, kind):
        raise ValueError(f"{type(env).__name__}: action must be {kind.__name__}, got {action.dtype}")
    tensor = torch.as_tensor(action).to(device=env.device, dtype=wanted)
    expected = env.action_spec.shape
    if tensor.shape != expected:
        raise ValueError(f"{type(env).__name__}: action must have shape {tuple(expected)}, got {tuple(tensor.shape)}")
    return tensor


def _step(env: SoftEnv, action: Array, active: Array | None = None) -> dict[str, Array]:
    """Step all worlds, or the active ones; everything as NumPy arrays that are nobody else's."""
    import torch
    from tensordict import TensorDict

    told = TensorDict({"action": _form(env, action)}, batch_size=env.batch_size)
    if active is not None:
        told["_step"] = torch.from_numpy(active).to(env.device)
    data = _to_numpy(env.step(told)["next"])
    env.raise_refused_actions()
    return data


def _to_numpy(data: Any) -> dict[str, Array]:
    """Leaves of a TensorDict; the trailing axis of length 1 dropped from flags and numbers."""

    def convert(key: str, value: Tensor) -> Array:
        array: Array = value.cpu().numpy()
        return array.reshape(len(array)) if key in _NUMBERS else array

    return {key: convert(key, value) for key, value in data.items()}


def _single_info(data: dict[str, Array]) -> dict[str, Any]:
    info = {key: data[key][0].item() for key in INFO_KEYS}
    info |= {key: data[key][0] for key in data if key not in _KNOWN}
    return info | ({MASK_KEY: data[MASK_KEY][0].astype(np.int8)} if MASK_KEY in data else {})


def _vector_info(data: dict[str, Array], mask: Array) -> dict[str, Any]:
    """Gymnasium's layout: an array per key, and under _key the worlds it is meant for; zeros in the others."""
    info: dict[str, Any] = {}
    for key in INFO_KEYS:
        info[key], info[f"_{key}"] = np.where(mask, data[key], np.zeros_like(data[key])), mask.copy()
    for key in (key for key in data if key not in _KNOWN):  # sensors
        info[key], info[f"_{key}"] = np.where(mask[:, None], data[key], 0.0).astype(np.float32), mask.copy()
    if MASK_KEY in data:
        info[MASK_KEY], info[f"_{MASK_KEY}"] = (data[MASK_KEY] & mask[:, None]).astype(np.int8), mask.copy()
    return info


def _shown(env: SoftEnv, window: Window | None) -> Window:
    """The page that shows an environment while it runs, with a picture of now; opened where there is none yet."""
    if window is None:
        from softwarp.view import Window as Page

        window = Page(env)
        if not env.captures.are_on:
            env.watcher = window.after_substep
        notices.log.warning("%s is shown at %s", type(env).__name__, window.url)
    window.draw()
    return window


def _hide(env: SoftEnv, window: Window | None) -> None:
    """Close the page, if there is one."""
    if window is not None:
        env.watcher = None
        window.close()


def _check_render_mode(mode: str | None, metadata: dict[str, Any]) -> str | None:
    if mode is not None and mode not in metadata["render_modes"]:
        raise ValueError(f"render_mode {mode!r} is not offered; use {metadata['render_modes']} or None")
    return mode


registry.follow(register)
