"""The table of environments: name -> class, loaded only when its class or options are asked for."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from softwarp import checks
from softwarp.advice import nearest

if TYPE_CHECKING:  # not a circle: base knows nothing of the table, but it loads Torch
    from softwarp.envs.base import EnvConfig, SoftEnv


@dataclass(frozen=True)
class EnvSpec:
    """One line of the table: what is told before a class is loaded; all else follows from the class."""

    env: str  # ``module:class``
    max_episode_steps: int  # default of its options
    summary: str

    @property
    def name(self) -> str:
        """What ``make`` calls it: the name of its class."""
        return self.env.partition(":")[2]

    @property
    def gym_id(self) -> str:
        """Its id in Gymnasium."""
        return f"softwarp/{self.name}-v0"

    @property
    def file_name(self) -> str:
        """Its name in ``env=`` and of its files: ``CartStem`` has ``cart_stem``."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", self.name).lower()

    def env_class(self) -> type[SoftEnv]:
        """The environment's class (imports Torch)."""
        module, _, name = self.env.partition(":")
        return cast("type[SoftEnv]", getattr(importlib.import_module(module), name))

    def config_class(self) -> type[EnvConfig]:
        """The dataclass of its options, which the class declares as its ``config`` (imports Torch)."""
        return cast("type[EnvConfig]", inspect.get_annotations(self.env_class(), eval_str=True)["config"])


TABLE = {  # file in tasks/ and class in it: steps of an episode, what it is about
    "trunk:Trunk": (250, "a silicone trunk with eight cables brings its tip to a point"),
    "cart_stem:CartStem": (80, "a cart keeps a heavy sphere above it that stands on a flexible stem"),
    "cart_stem_contact:CartStemContact": (
        30,
        "a cart leans its stem on one obstacle to bring the tip behind the other",
    ),
    "cart_pole:CartPole": (80, "a cart keeps a rigid pole upright that is hinged to it"),
    "catch_the_object:CatchTheObject": (30, "two inflatable pads hold a falling ball and let it go into a moving cart"),
    "stem_pendulum:StemPendulum": (50, "a weak motor swings a soft rod up and keeps it upright"),
    "diamond:Diamond": (50, "a hollow silicone body with four cables brings its top to a point"),
}
ENVIRONMENTS: dict[str, EnvSpec] = {
    spec.name: spec for spec in (EnvSpec(f"softwarp.envs.tasks.{place}", *told) for place, told in TABLE.items())
}


def names() -> list[str]:
    """Names that ``make`` accepts."""
    return list(ENVIRONMENTS)


def spec(name: str) -> EnvSpec:
    """The table's line for ``name``.

    Raises:
        ValueError: If there is no such environment; the message lists the nearest names.
    """
    if not isinstance(name, str) or name not in ENVIRONMENTS:
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
    if seed is not None:
        checks.seed(seed)
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
    return checks.count(num_worlds, "num_worlds")


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
