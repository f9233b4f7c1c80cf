"""The table of planners: name -> settings and class."""

from __future__ import annotations

from typing import Any

from softwarp.planning.cem import CEM
from softwarp.planning.mppi import MPPI
from softwarp.planning.olop import OLOP
from softwarp.planning.opd import OPD
from softwarp.planning.options import CONFIGS, OLOPConfig, OPDConfig, PlannerConfig, UCTConfig
from softwarp.planning.search import Planner
from softwarp.planning.uct import UCT

_CLASSES = {"opd": OPD, "uct": UCT, "olop": OLOP, "kl_olop": OLOP, "cem": CEM, "mppi": MPPI}
PLANNERS: dict[str, tuple[type[PlannerConfig], Any]] = {name: (CONFIGS[name], kind) for name, kind in _CLASSES.items()}


def make_planner(config: PlannerConfig) -> Planner:
    """The planner whose settings ``config`` holds.

    Raises:
        ValueError: If there is no planner of that name.
    """
    if config.name not in PLANNERS:
        raise ValueError(f"planner.name: {config.name!r} is unknown; choose from {', '.join(PLANNERS)}")
    planner: Planner = PLANNERS[config.name][1](config)
    return planner


def pool_size(config: PlannerConfig, action_count: int) -> int:
    """Worlds that take a round of a planner in one step."""
    if isinstance(config, OPDConfig):
        return config.batch * max(action_count, 1)
    if isinstance(config, UCTConfig | OLOPConfig):
        return config.batch
    return int(getattr(config, "population", 1))
