"""Settings: of planners; loading them loads no Torch."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from softwarp.ranges import Limit, Seed, check_fields


@dataclass(kw_only=True)
class PlannerConfig:
    """Settings of every planner.

    An expansion of a node steps all its actions, K model steps; for planners that sample sequences it is K model steps
    too (1 where actions are continuous). Equal budgets are thus equal work.
    """

    name: str = ""
    gamma: float = 0.95  # discount per action of the plan
    expansions: int = 1000  # budget
    seconds: Limit = math.inf  # budget; whichever ends first, after one round. Ended by time, it is not repeatable
    until_success: bool = False  # stop at the first plan that meets the goal
    seed: Seed = 0  # of the planner's own draws

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "planner")
        if not 0.0 < self.gamma < 1.0:
            raise ValueError(f"planner.gamma: must lie in (0, 1), got {self.gamma:g}")
        self.require("expansions", self.expansions >= 1, "at least 1")
        self.require("seconds", self.seconds > 0.0, "positive")

    def require(self, name: str, holds: bool, requirement: str) -> None:
        """Refuse a value that does not meet its requirement.

        Raises:
            ValueError: Naming setting, requirement and value.
        """
        if not holds:
            raise ValueError(f"planner.{name}: must be {requirement}, got {getattr(self, name)!r}")


@dataclass(kw_only=True)
class SequencesConfig(PlannerConfig):
    """Settings of planners that sample sequences; the budget counts actions."""

    gamma: float = 0.99
    expansions: int = 10_000
    population: int = 64  # sequences per round
    horizon: int = 0  # actions of a sequence; 0: what the episode has left
    spread: float = 0.6  # standard deviation of the first samples, actions being in [-1, 1]
    nominal: list[float] | None = None  # what new actions of the mean are; None: 0 at first, then the mean's last one
    nominal_cost: float = 0.0  # taken from the value of a sequence, times its mean square distance from the nominal

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("population", self.population >= 2, "at least 2")
        self.require("horizon", self.horizon >= 0, "at least 0")
        self.require("spread", self.spread > 0.0, "positive")
        in_range = self.nominal is None or all(-1.0 <= entry <= 1.0 for entry in self.nominal)
        self.require("nominal", in_range, "null, or entries in [-1, 1], one for each of an action")
        self.require("nominal_cost", self.nominal_cost >= 0.0, "at least 0")


@dataclass(kw_only=True)
class CEMConfig(SequencesConfig):
    """Settings of CEM."""

    name: str = "cem"
    elites: int = 8  # best samples, to which the distribution is fitted
    inertia: float = 0.1  # part of the old mean and deviation that stays
    least_spread: float = 0.02  # standard deviation never gets smaller
    persistence: float = 0.8  # correlation of the noise of neighbouring actions, in [0, 1)

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("elites", 1 <= self.elites < self.population, "at least 1 and less than the population")
        self.require("inertia", 0.0 <= self.inertia < 1.0, "in [0, 1)")
        self.require("least_spread", self.least_spread >= 0.0, "at least 0")
        self.require("persistence", 0.0 <= self.persistence < 1.0, "in [0, 1)")


@dataclass(kw_only=True)
class MPPIConfig(SequencesConfig):
    """Settings of MPPI."""

    name: str = "mppi"
    effective: float = 0.1  # part of the samples that the weights leave effective
    decay: float = 0.8  # factor of the standard deviation from round to round
    persistence: float = 0.8  # correlation of the noise of neighbouring actions, in [0, 1)

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("effective", 0.0 < self.effective < 1.0, "in (0, 1)")
        self.require("decay", 0.0 < self.decay <= 1.0, "in (0, 1]")
        self.require("persistence", 0.0 <= self.persistence < 1.0, "in [0, 1)")


@dataclass(kw_only=True)
class OLOPConfig(PlannerConfig):
    """Settings of OLOP and KL-OLOP."""

    name: str = "olop"
    bound: str = "hoeffding"  # "hoeffding": OLOP; "kl": KL-OLOP
    batch: int = 8  # sequences that are run together
    length: int = 0  # actions of a sequence; 0: as the paper derives it from budget and discount

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("batch", self.batch >= 1, "at least 1")
        self.require("length", self.length >= 0, "at least 0")
        self.require("bound", self.bound in ("hoeffding", "kl"), "'hoeffding' or 'kl'")


@dataclass(kw_only=True)
class KLOLOPConfig(OLOPConfig):
    """Settings of KL-OLOP."""

    name: str = "kl_olop"
    bound: str = "kl"


@dataclass(kw_only=True)
class OPDConfig(PlannerConfig):
    """Settings of OPD."""

    name: str = "opd"
    batch: int = 8  # leaves that are expanded together
    reuse: bool = True  # keep the tree below the state reached by the actions carried out
    merge: bool = True  # expand one of the nodes that are alike, where the task tells which are
    patience: int = 1  # budgets that a plan may spend while nothing in its tree comes nearer to the goal than its root

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("batch", self.batch >= 1, "at least 1")
        self.require("patience", self.patience >= 1, "at least 1")


@dataclass(kw_only=True)
class UCTConfig(PlannerConfig):
    """Settings of UCT."""

    name: str = "uct"
    batch: int = 8  # searches that are valued together
    horizon: int = 10  # actions of a search, random ones included; at most what the episode has left
    exploration: float = math.sqrt(2.0)  # C

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("batch", self.batch >= 1, "at least 1")
        self.require("horizon", self.horizon >= 1, "at least 1")
        self.require("exploration", self.exploration >= 0.0, "at least 0")


@dataclass
class ModelConfig:
    """How an environment is presented to a planner."""

    hold: int = 1  # environment steps that an action of the plan is held for
    strides: list[int] = field(default_factory=lambda: [1])  # multiples of hold that opd chooses from for each action
    levels: int = 5  # per entry of a continuous action, for planners of discrete actions
    objective: str = "reward"  # "reward" of the task, or "distance" to the goal
    reward_range: list[float] | None = None  # of a step, scaled to [0, 1]; None takes the environment's
    memory: float = 256.0  # MiB for states of tree nodes

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "model")
        if self.hold < 1:
            raise ValueError(f"hold: must be at least 1 environment step, got {self.hold}")
        if not self.strides or min(self.strides) < 1 or len(set(self.strides)) < len(self.strides):
            raise ValueError(f"strides: must be different numbers of at least 1, got {self.strides}")
        if self.levels < 2:
            raise ValueError(f"levels: must be at least 2, got {self.levels}")
        if not 0.0 < self.memory < math.inf:
            raise ValueError(f"memory: must be positive and finite [MiB], got {self.memory:g}")
        if self.reward_range is not None and len(self.reward_range) != 2:
            raise ValueError(f"reward_range: needs 2 values, low and high, got {self.reward_range}")


CONFIGS: dict[str, type[PlannerConfig]] = {
    "opd": OPDConfig,
    "uct": UCTConfig,
    "olop": OLOPConfig,
    "kl_olop": KLOLOPConfig,
    "cem": CEMConfig,
    "mppi": MPPIConfig,
}
