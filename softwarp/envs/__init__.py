"""Environments, made by ``softwarp.make``: a class and a configuration for each line of the registry.

Importing this package loads no Torch; that happens when a class is asked for.
"""

from __future__ import annotations

import importlib
from typing import Any

from softwarp.envs import registry

make, names, spec = registry.make, registry.names, registry.spec
_BASES = {"EnvConfig": "options.base", "EnvSnapshot": "snapshot", "SoftEnv": "base"}  # class -> its file
_CONFIGS = {f"{name}Config": name for name in registry.ENVIRONMENTS}

_NAMES = ["make", "names", "spec", *_BASES, *registry.ENVIRONMENTS, *_CONFIGS]
__all__ = list(_NAMES)


def __getattr__(name: str) -> Any:
    if name in registry.ENVIRONMENTS:
        return spec(name).env_class()
    if name in _CONFIGS:
        return spec(_CONFIGS[name]).config_class()
    if name in _BASES:
        return getattr(importlib.import_module(f"{__name__}.{_BASES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return _NAMES
