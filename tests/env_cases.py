"""Environments of the table with each kind of action, for tests that all of them have to pass."""

import importlib
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
ALL_NAMES = [pytest.param(name, marks=pytest.mark.slow if name in SLOWEST else ()) for name in registry.names()]
NAMES = [pytest.param(name, marks=pytest.mark.slow if name in LARGE else ()) for name in registry.names()]


def _is_first(case: Case) -> bool:
    return case == next(other for other in CASES if other[0] == case[0])


def _is_slow(case: Case) -> bool:
    return case[0] in LARGE or not _is_first(case)


def _is_long(case: Case) -> bool:
    return case[0] in SLOWEST or (case[0] in LARGE and not _is_first(case))


# Each case, of which the largest environment and those after the first of a large one are slow.
EVERY_CASE = pytest.mark.parametrize(
    "case", [pytest.param(case, id=case_id(case), marks=pytest.mark.slow if _is_long(case) else ()) for case in CASES]
)
# Each case, of which the large ones and those after the first of an environment are slow.
FIRST_AND_SLOW = pytest.mark.parametrize(
    "case",
    [pytest.param(case, id=case_id(case), marks=pytest.mark.slow if _is_slow(case) else ()) for case in CASES],
)
