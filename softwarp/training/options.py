"""Settings: of a run, its algorithm and what it clones first; loading them loads no Torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from softwarp.ranges import Limit, Seed, check_fields

SCHEDULES = ("constant", "linear", "adaptive")


@dataclass
class AlgorithmConfig:
    """Settings that all algorithms have."""

    name: str = ""  # of the algorithm; set by its own dataclass
    horizon: int = 32  # steps per world and update, T
    learning_rate: float = 1e-3  # of Adam
    schedule: str = "linear"  # of the learning rate: constant, or falling over the run
    gamma: float = 0.95  # discount
    max_grad_norm: float = 1.0  # longer gradients are cut to it
    scale_rewards: bool = False  # divide rewards by the running standard deviation of the discounted return
    critic_bias: float = 1.0  # beta in the critic's loss Var(e) + beta mean(e)^2; 1: mean squares, 0: AVEC
    shift_critic: bool = True  # with beta < 1, put the mean error back into the critic's last bias
    stagger: bool = True  # cut each world's first episode at random, so that resets are spread over time

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "algo")
        self.require("horizon", self.horizon >= 1, "be at least 1")
        for name in ("learning_rate", "max_grad_norm"):
            value = getattr(self, name)
            self.require(name, math.isfinite(value) and value > 0.0, "be positive")
        for name in ("gamma", "critic_bias"):
            self.require(name, 0.0 <= getattr(self, name) <= 1.0, "lie in [0, 1]")
        if self.schedule not in SCHEDULES:
            raise ValueError(f"algo.schedule: {self.schedule!r} is unknown; choose from {', '.join(SCHEDULES)}")

    def require(self, name: str, holds: bool, requirement: str) -> None:
        """Raise ValueError, naming the setting and its value, unless ``holds``."""
        value = getattr(self, name)
        if not holds:
            told = f"{value:g}" if isinstance(value, float) else value
            raise ValueError(f"algo.{name}: must {requirement}, got {told}")


@dataclass
class PPOConfig(AlgorithmConfig):
    """Settings of PPO; ``schedule`` may also be adaptive: the KL divergence is kept near ``target_kl``."""

    name: str = "ppo"
    epochs: int = 8  # passes over what an update has collected
    minibatches: int = 4  # parts of it, one gradient step each
    target_kl: float = 0.02  # per update; epochs stop at 1.5 times this; 0: never
    gae_lambda: float = 0.95  # of generalised advantage estimation
    clip: float = 0.2  # of the ratio of probabilities, epsilon
    entropy: float = 0.0  # weight c_e
    value: float = 0.5  # weight c_v
    warmup_updates: int = 0  # first updates that fit the critic only, for a policy that knows something already
    bootstrap: bool = True  # count what would follow a time limit; False: the task is over there, as in SofaGym

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("name", self.name == "ppo", "stay 'ppo'; choose another algorithm with algo=sac")
        for name in ("epochs", "minibatches"):
            self.require(name, getattr(self, name) >= 1, "be at least 1")
        for name in ("clip", "value"):
            self.require(name, getattr(self, name) > 0.0, "be positive")
        self.require("gae_lambda", 0.0 <= self.gae_lambda <= 1.0, "lie in [0, 1]")
        for name in ("target_kl", "entropy", "warmup_updates"):
            self.require(name, getattr(self, name) >= 0.0, "not be negative")
        if self.stagger and not self.bootstrap:
            raise ValueError(
                "algo.bootstrap: false needs algo.stagger=false, as first episodes that are cut at random would be over"
            )
        if self.schedule == "adaptive" and self.target_kl == 0.0:
            raise ValueError("algo.schedule: adaptive needs algo.target_kl > 0")


@dataclass
class SACConfig(AlgorithmConfig):
    """Settings of SAC."""

    name: str = "sac"
    horizon: int = 4
    learning_rate: float = 5e-4  # of Adam
    schedule: str = "constant"
    scale_rewards: bool = True
    batch: int = 512  # transitions per gradient step
    update_ratio: float = 0.125  # gradient steps per transition collected
    capacity: int = 1_000_000  # transitions in the replay
    prioritized: bool = False  # draw transitions with large errors more often
    warmup_steps: int = 2_000  # environment steps with random actions and no learning
    tau: float = 0.005  # of the way that the slow copies move to the Q-functions in a gradient step
    initial_alpha: float = 0.2  # temperature
    alpha_rate: float = 3e-3  # learning rate of its logarithm
    tune_alpha: bool = True  # so that the entropy is the target's
    target_entropy: float | None = None  # None: -dim(action), or 0.3 log(choices)
    save_replay: bool = True  # in checkpoints; without it a resumed run refills the replay, and is not the same run

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("name", self.name == "sac", "stay 'sac'; choose another algorithm with algo=ppo")
        for name in ("batch", "capacity"):
            self.require(name, getattr(self, name) >= 1, "be at least 1")
        for name in ("update_ratio", "initial_alpha", "alpha_rate"):
            self.require(name, getattr(self, name) > 0.0, "be positive")
        self.require("warmup_steps", self.warmup_steps >= 0, "not be negative")
        self.require("tau", 0.0 < self.tau <= 1.0, "lie in (0, 1]")
        if self.schedule == "adaptive":
            raise ValueError("algo.schedule: adaptive belongs to PPO; choose constant or linear")


@dataclass
class SHACConfig(AlgorithmConfig):
    """Settings of SHAC, for environments whose steps have gradients and actions that are continuous."""

    name: str = "shac"
    horizon: int = 16
    learning_rate: float = 2e-3  # of Adam, for the actor
    gamma: float = 0.95  # discount
    critic_rate: float = 2e-3  # of Adam, for the critic; follows the schedule too
    critic_epochs: int = 8  # passes of the critic over what an update has collected
    minibatches: int = 4  # parts of it, one step of the critic each
    td_lambda: float = 0.95  # of the critic's targets
    tau: float = 0.4  # of the way that the slow copy of the critic moves to it in an update

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        super().__post_init__()
        self.require("name", self.name == "shac", "stay 'shac'; choose another algorithm with algo=ppo")
        for name in ("critic_epochs", "minibatches"):
            self.require(name, getattr(self, name) >= 1, "be at least 1")
        value = self.critic_rate
        self.require("critic_rate", math.isfinite(value) and value > 0.0, "be positive")
        self.require("td_lambda", 0.0 <= self.td_lambda <= 1.0, "lie in [0, 1]")
        self.require("tau", 0.0 < self.tau <= 1.0, "lie in (0, 1]")
        if self.schedule == "adaptive":
            raise ValueError("algo.schedule: adaptive belongs to PPO; choose constant or linear")


@dataclass
class CloningConfig:
    """Settings of behaviour cloning."""

    path: str | None = None  # of demonstrations; None: no cloning, or with ``rounds`` some of the demonstrator's own
    rounds: int = 0  # in which the clone acts, and learns what the demonstrator would have done instead
    demonstrator: str = "scripted"  # of the rounds: hand-written policy by name, inverse, or a trained run
    window: int = 8  # newest rounds that are learned from, besides the demonstrations
    epochs: int = 300  # at most
    patience: int = 30  # epochs without a better fit of the held-out episodes, after which to stop
    batch: int = 256  # transitions per gradient step
    learning_rate: float = 1e-3  # of Adam
    held_out: float = 0.1  # part of the episodes

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "cloning")
        for name in ("epochs", "patience", "batch", "window"):
            if getattr(self, name) < 1:
                raise ValueError(f"cloning.{name}: must be at least 1, got {getattr(self, name)}")
        if self.rounds < 0:
            raise ValueError(f"cloning.rounds: must be 0, for none, or more, got {self.rounds}")
        if not (math.isfinite(self.learning_rate) and self.learning_rate > 0.0):
            raise ValueError(f"cloning.learning_rate: must be positive, got {self.learning_rate:g}")
        if not 0.0 < self.held_out < 1.0:
            raise ValueError(f"cloning.held_out: must lie in (0, 1), got {self.held_out:g}")

    @property
    def is_asked(self) -> bool:
        """Whether anything is to be cloned."""
        return self.path is not None or self.rounds > 0


@dataclass
class DistributedConfig:
    """Processes that train together; ``torchrun`` says the same of those that it starts."""

    ranks: int = 1  # processes that softwarp train starts on this machine, each with ``num_worlds`` worlds
    restarts: int = 0  # times that they are started again, from the last checkpoint, when one of them dies
    pin: bool = True  # on CPUs, give each rank its share of the cores that this process may use

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "distributed")
        if self.ranks < 1:
            raise ValueError(f"distributed.ranks: must be at least 1, got {self.ranks}")
        if self.restarts < 0:
            raise ValueError(f"distributed.restarts: must not be negative, got {self.restarts}")


@dataclass
class RunConfig:
    """How long to train, and how often to look and to save."""

    total_steps: int = 1_000_000  # environment steps, summed over worlds and ranks
    time_limit: Limit = math.inf  # s, without compiling kernels; the run ends at whichever comes first
    evaluations: int = 10  # evenly spaced, the last one at the end; 0: never
    evaluation_episodes: int = 64  # of each
    evaluation_deterministic: bool = True  # most likely actions instead of drawn ones
    evaluate_start: bool = False  # also evaluate the policy that learned nothing
    evaluation_seed: Seed = 1_000_003  # of the goals that training does not see
    checkpoint_seconds: float = 30.0  # s between checkpoints; each waits for the end of an update, but for the last
    keep_checkpoints: int = 3  # the newest ones

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "run")
        for name in ("total_steps", "evaluation_episodes", "keep_checkpoints"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        for name in ("evaluations", "evaluation_seed", "checkpoint_seconds"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: must not be negative, got {getattr(self, name)}")
        if not self.time_limit > 0.0:
            raise ValueError(f"time_limit: must be a positive number of seconds, got {self.time_limit:g}")


CONFIGS: dict[str, type[AlgorithmConfig]] = {"ppo": PPOConfig, "sac": SACConfig, "shac": SHACConfig}


def config_class(name: str) -> type[AlgorithmConfig]:
    """Dataclass of the settings of algorithm ``name``.

    Raises:
        ValueError: If there is no such algorithm.
    """
    if name not in CONFIGS:
        raise ValueError(f"algo.name: {name!r} is unknown; choose from {', '.join(CONFIGS)}")
    return CONFIGS[name]
