"""Environments: one file per task, made by ``softwarp.make``. Importing this package loads no Torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softwarp.envs.base import EnvConfig as EnvConfig
    from softwarp.envs.base import SoftEnv as SoftEnv
    from softwarp.envs.registry import make as make
    from softwarp.envs.registry import names as names
    from softwarp.envs.registry import spec as spec
    from softwarp.envs.snapshot import EnvSnapshot as EnvSnapshot
    from softwarp.envs.tasks.cart_pole import CartPole as CartPole
    from softwarp.envs.tasks.cart_pole import CartPoleConfig as CartPoleConfig
    from softwarp.envs.tasks.cart_stem import CartStem as CartStem
    from softwarp.envs.tasks.cart_stem import CartStemConfig as CartStemConfig
    from softwarp.envs.tasks.cart_stem_contact import CartStemContact as CartStemContact
    from softwarp.envs.tasks.cart_stem_contact import CartStemContactConfig as CartStemContactConfig
    from softwarp.envs.tasks.catch_the_object import CatchTheObject as CatchTheObject
    from softwarp.envs.tasks.catch_the_object import CatchTheObjectConfig as CatchTheObjectConfig
    from softwarp.envs.tasks.diamond import Diamond as Diamond
    from softwarp.envs.tasks.diamond import DiamondConfig as DiamondConfig
    from softwarp.envs.tasks.stem_pendulum import StemPendulum as StemPendulum
    from softwarp.envs.tasks.stem_pendulum import StemPendulumConfig as StemPendulumConfig
    from softwarp.envs.tasks.trunk import Trunk as Trunk
    from softwarp.envs.tasks.trunk import TrunkConfig as TrunkConfig

_HOME = {
    "EnvConfig": "base",
    "EnvSnapshot": "snapshot",
    "SoftEnv": "base",
    "make": "registry",
    "names": "registry",
    "spec": "registry",
    "CartPole": "tasks.cart_pole",
    "CartPoleConfig": "tasks.cart_pole",
    "CartStem": "tasks.cart_stem",
    "CartStemConfig": "tasks.cart_stem",
    "CartStemContact": "tasks.cart_stem_contact",
    "CartStemContactConfig": "tasks.cart_stem_contact",
    "CatchTheObject": "tasks.catch_the_object",
    "CatchTheObjectConfig": "tasks.catch_the_object",
    "Diamond": "tasks.diamond",
    "DiamondConfig": "tasks.diamond",
    "StemPendulum": "tasks.stem_pendulum",
    "StemPendulumConfig": "tasks.stem_pendulum",
    "Trunk": "tasks.trunk",
    "TrunkConfig": "tasks.trunk",
}
__all__ = [
    "CartPole",
    "CartPoleConfig",
    "CartStem",
    "CartStemConfig",
    "CartStemContact",
    "CartStemContactConfig",
    "CatchTheObject",
    "CatchTheObjectConfig",
    "Diamond",
    "DiamondConfig",
    "EnvConfig",
    "EnvSnapshot",
    "SoftEnv",
    "StemPendulum",
    "StemPendulumConfig",
    "Trunk",
    "TrunkConfig",
    "make",
    "names",
    "spec",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
