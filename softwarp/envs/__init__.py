"""Environments: one file per task, made by ``softwarp.make``. Importing this package loads no Torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softwarp.envs.base import EnvConfig as EnvConfig
    from softwarp.envs.base import SoftEnv as SoftEnv
    from softwarp.envs.cart_pole import CartPole as CartPole
    from softwarp.envs.cart_pole import CartPoleConfig as CartPoleConfig
    from softwarp.envs.cart_stem import CartStem as CartStem
    from softwarp.envs.cart_stem import CartStemConfig as CartStemConfig
    from softwarp.envs.cart_stem_contact import CartStemContact as CartStemContact
    from softwarp.envs.cart_stem_contact import CartStemContactConfig as CartStemContactConfig
    from softwarp.envs.catch_the_object import CatchTheObject as CatchTheObject
    from softwarp.envs.catch_the_object import CatchTheObjectConfig as CatchTheObjectConfig
    from softwarp.envs.diamond import Diamond as Diamond
    from softwarp.envs.diamond import DiamondConfig as DiamondConfig
    from softwarp.envs.registry import make as make
    from softwarp.envs.registry import names as names
    from softwarp.envs.registry import spec as spec
    from softwarp.envs.snapshot import EnvSnapshot as EnvSnapshot
    from softwarp.envs.stem_pendulum import StemPendulum as StemPendulum
    from softwarp.envs.stem_pendulum import StemPendulumConfig as StemPendulumConfig
    from softwarp.envs.trunk import Trunk as Trunk
    from softwarp.envs.trunk import TrunkConfig as TrunkConfig

_HOME = {
    "EnvConfig": "base",
    "EnvSnapshot": "snapshot",
    "SoftEnv": "base",
    "make": "registry",
    "names": "registry",
    "spec": "registry",
    "CartPole": "cart_pole",
    "CartPoleConfig": "cart_pole",
    "CartStem": "cart_stem",
    "CartStemConfig": "cart_stem",
    "CartStemContact": "cart_stem_contact",
    "CartStemContactConfig": "cart_stem_contact",
    "CatchTheObject": "catch_the_object",
    "CatchTheObjectConfig": "catch_the_object",
    "Diamond": "diamond",
    "DiamondConfig": "diamond",
    "StemPendulum": "stem_pendulum",
    "StemPendulumConfig": "stem_pendulum",
    "Trunk": "trunk",
    "TrunkConfig": "trunk",
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
