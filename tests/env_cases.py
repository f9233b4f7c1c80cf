"""Environments of the table with each kind of action, for tests that all of them have to pass."""

import importlib
from collections.abc import Collection
from typing import Any

import pytest

from softwarp.envs import registry

Case = tuple[str, dict[str, Any]]

# Options that make an environment quick to build.
FAST: dict[str, dict[str, Any]] = {name: {"mesh": "coarse"} for name in ("Trunk", "Diamond")}
FAST["Gripper"] = {"finger": "plain"}
FAST["CatheterBeam"] = {"grid": 0.003, "segments": 24}
FAST["MultiGaitFull"] = FAST["MultiGaitReduced"] = {"action_repeat": 4, "ramp": 2}
DOUBLE = {"CatheterBeam"}  # simulated in float64, for which there are no lanes


def path_of(name: str, path: str) -> str:
    """The solver path that an environment has instead of ``path``."""
    return "scalar" if name in DOUBLE and path == "lanes" else path


def _cases() -> list[Case]:
    cases: list[Case] = []
    for name in registry.names():
        kinds = getattr(importlib.import_module(registry.spec(name).env.partition(":")[0]), "ACTION_KINDS", ())
        cases += [(name, {"action_kind": kind}) for kind in kinds] or [(name, {})]
    return cases


CASES = _cases()


def case_id(case: Case) -> str:
    """Name of a case in test reports."""
    return "-".join((case[0], *case[1].values()))


# Environments whose kernels take long to compile, and to run.
LARGE = {"BubbleMotion", "Gripper", "Maze", "MultiGaitFull", "MultiGaitReduced", "TrunkCup"}
SLOWEST = {"MultiGaitFull"}  # minutes: MultiGaitReduced has its task in seconds
SMALL = [name for name in registry.names() if name not in LARGE]


def quick_ones(names: Collection[str]) -> list[Any]:
    """Names of all environments, of which those that are not among ``names`` are slow."""
    return [pytest.param(name, marks=() if name in names else pytest.mark.slow) for name in registry.names()]


def _cases_of(names: Collection[str]) -> Any:
    """Each case, of which the first of each of these environments is quick."""
    first = [next(case for case in CASES if case[0] == name) for name in names]
    cases = [pytest.param(c, id=case_id(c), marks=() if c in first else pytest.mark.slow) for c in CASES]
    return pytest.mark.parametrize("case", cases)


NAMES = quick_ones(SMALL)
# Every environment once, but for the slowest, with the first of its kinds of actions.
FIRST_OF_EACH = _cases_of([name for name in registry.names() if name not in SLOWEST])


def some(turn: int) -> list[Any]:
    """Names for a check that needs an environment of its own: quick for a third of the small ones, slow for the others.

    Checks of one kind begin at different ones, ``turn`` = 0, 1 or 2, so that together they look at every one.
    """
    return quick_ones(SMALL[turn::3])


def some_cases(turn: int) -> Any:
    """The same for each case: the first of each of these environments is quick."""
    return _cases_of(SMALL[turn::3])
