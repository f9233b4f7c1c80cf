"""The table of environments: name -> class and configuration, loaded only when one is made."""

from __future__ import annotations

import dataclasses
import importlib
import numbers
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from softwarp.advice import nearest

if TYPE_CHECKING:
    from softwarp.envs.base import EnvConfig, SoftEnv


@dataclass(frozen=True)
class EnvSpec:
    """One line of the table; ``env`` and ``config`` are ``module:class``, so listing imports nothing heavy."""

    name: str
    env: str
    config: str
    gym_id: str
    max_episode_steps: int
    summary: str

    @property
    def file_name(self) -> str:
        """Name of its settings file and in ``env=``: ``CartStem`` has ``cart_stem``."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", self.name).lower()

    def env_class(self) -> type[SoftEnv]:
        """The environment's class (imports Torch)."""
        return cast("type[SoftEnv]", _load(self.env))

    def config_class(self) -> type[EnvConfig]:
        """The dataclass of its options (imports Torch)."""
        return cast("type[EnvConfig]", _load(self.config))


ENVIRONMENTS: dict[str, EnvSpec] = {
    spec.name: spec
    for spec in (
        EnvSpec(
            name="Trunk",
            env="softwarp.envs.tasks.trunk:Trunk",
            config="softwarp.envs.tasks.trunk:TrunkConfig",
            gym_id="softwarp/Trunk-v0",
            max_episode_steps=250,
            summary="a silicone trunk with eight cables brings its tip to a point",
        ),
        EnvSpec(
            name="CartStem",
            env="softwarp.envs.tasks.cart_stem:CartStem",
            config="softwarp.envs.tasks.cart_stem:CartStemConfig",
            gym_id="softwarp/CartStem-v0",
            max_episode_steps=80,
            summary="a cart keeps a heavy sphere above it that stands on a flexible stem",
        ),
        EnvSpec(
            name="CartStemContact",
            env="softwarp.envs.tasks.cart_stem_contact:CartStemContact",
            config="softwarp.envs.tasks.cart_stem_contact:CartStemContactConfig",
            gym_id="softwarp/CartStemContact-v0",
            max_episode_steps=30,
            summary="a cart leans its stem on one obstacle to bring the tip behind the other",
        ),
        EnvSpec(
            name="CartPole",
            env="softwarp.envs.tasks.cart_pole:CartPole",
            config="softwarp.envs.tasks.cart_pole:CartPoleConfig",
            gym_id="softwarp/CartPole-v0",
            max_episode_steps=80,
            summary="a cart keeps a rigid pole upright that is hinged to it",
        ),
        EnvSpec(
            name="CatchTheObject",
            env="softwarp.envs.tasks.catch_the_object:CatchTheObject",
            config="softwarp.envs.tasks.catch_the_object:CatchTheObjectConfig",
            gym_id="softwarp/CatchTheObject-v0",
            max_episode_steps=30,
            summary="two inflatable pads hold a falling ball and let it go into a moving cart",
        ),
        EnvSpec(
            name="StemPendulum",
            env="softwarp.envs.tasks.stem_pendulum:StemPendulum",
            config="softwarp.envs.tasks.stem_pendulum:StemPendulumConfig",
            gym_id="softwarp/StemPendulum-v0",
            max_episode_steps=50,
            summary="a weak motor swings a soft rod up and keeps it upright",
        ),
        EnvSpec(
            name="Diamond",
            env="softwarp.envs.tasks.diamond:Diamond",
            config="softwarp.envs.tasks.diamond:DiamondConfig",
            gym_id="softwarp/Diamond-v0",
            max_episode_steps=50,
            summary="a hollow silicone body with four cables brings its top to a point",
        ),
    )
}


def names() -> list[str]:
    """Names that ``make`` accepts."""
    return list(ENVIRONMENTS)


def spec(name: str) -> EnvSpec:
    """The table's line for ``name``.

    Raises:
        ValueError: If there is no such environment; the message lists the nearest names.
    """
    if name not in ENVIRONMENTS:
        raise ValueError(f"unknown environment {name!r}; {nearest(name, names())}")
    return ENVIRONMENTS[name]


def make(
    name: str,
    *,
    num_worlds: int = 1,
    device: str = "cpu",
    seed: int | None = None,
    config: EnvConfig | None = None,
    **options: Any,
) -> SoftEnv:
    """Make a batched TorchRL environment.

    Args:
        name: A name of ``names()``, for example ``"Trunk"``.
        num_worlds: How many independent worlds step together, at least 1.
        device: ``"cpu"`` or ``"cuda:0"`` and the like; simulation and tensors live there.
        seed: Seed of every random draw; None takes one from the operating system (``env.seed`` tells it).
        config: Options as a dataclass; None takes the defaults.
        **options: Single fields of the dataclass, overriding ``config``.

    Raises:
        ValueError: If the name, an option, the number of worlds or the device is not valid.
    """
    entry = spec(name)
    return entry.env_class()(
        make_config(name, config, options),
        num_worlds=check_num_worlds(num_worlds),
        device=check_device(device),
        seed=seed,
    )


def make_config(name: str, config: EnvConfig | None, options: dict[str, Any]) -> EnvConfig:
    """Options of environment ``name``: ``config`` or the defaults, with single fields replaced.

    Raises:
        ValueError: If an option is unknown (nearest names are listed) or ``config`` belongs to another environment.
    """
    cls = spec(name).config_class()
    if config is not None and not isinstance(config, cls):
        raise ValueError(f"environment {name!r}: config must be a {cls.__name__}, got {type(config).__name__}")
    valid = [field.name for field in dataclasses.fields(cls)]
    unknown = [key for key in options if key not in valid]
    if unknown:
        advice = "; ".join(f"{key!r}: {nearest(key, valid)}" for key in unknown)
        raise ValueError(f"environment {name!r} has no option {', '.join(map(repr, unknown))}; {advice}")
    return cls(**options) if config is None else dataclasses.replace(config, **options)


def check_num_worlds(num_worlds: int) -> int:
    """The number of worlds as a plain int.

    Raises:
        ValueError: If it is not an integer of at least 1.
    """
    if isinstance(num_worlds, bool) or not isinstance(num_worlds, numbers.Integral) or num_worlds < 1:
        raise ValueError(f"num_worlds must be an integer of at least 1, got {num_worlds!r}")
    return int(num_worlds)


def check_device(device: str) -> str:
    """The device's full name, ``"cpu"`` or ``"cuda:<index>"``.

    Raises:
        ValueError: If there is no such device here; the message lists those that are.
    """
    import torch

    present = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    name = str(device)
    if name == "cuda" and len(present) > 1:
        name = f"cuda:{torch.cuda.current_device()}"
    if name not in present:
        raise ValueError(f"device {device!r} is not available; this machine has {', '.join(present)}")
    return name


def _load(path: str) -> Any:
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)
