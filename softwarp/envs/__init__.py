"""Environments: one file per task, made by ``softwarp.make``. Importing this package loads no Torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from softwarp.envs.base import EnvConfig as EnvConfig
    from softwarp.envs.base import EnvSnapshot as EnvSnapshot
    from softwarp.envs.base import SoftEnv as SoftEnv
    from softwarp.envs.registry import make as make
    from softwarp.envs.registry import names as names
    from softwarp.envs.registry import spec as spec
    from softwarp.envs.trunk import Trunk as Trunk
    from softwarp.envs.trunk import TrunkConfig as TrunkConfig

_HOME = {
    "EnvConfig": "base",
    "EnvSnapshot": "base",
    "SoftEnv": "base",
    "make": "registry",
    "names": "registry",
    "spec": "registry",
    "Trunk": "trunk",
    "TrunkConfig": "trunk",
}
__all__ = ["EnvConfig", "EnvSnapshot", "SoftEnv", "Trunk", "TrunkConfig", "make", "names", "spec"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
