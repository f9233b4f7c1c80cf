"""Short training runs on a point that moves to a goal."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from softwarp.policies.policy import NetworkConfig
from softwarp.training.evaluation import run_episodes
from softwarp.training.logs import LoggerConfig
from softwarp.training.loop import Outcome, RunConfig, train
from softwarp.training.ppo import PPO, PPOConfig
from tests.unit.training.reach import PointReach

QUIET = LoggerConfig(tensorboard=False, progress=False)


@pytest.fixture
def start_run(tmp_path: Path) -> Callable[..., tuple[PPO, Outcome]]:
    """A function that runs PPO on the point in ``tmp_path`` or in the folder given."""

    def start(
        total_steps: int,
        folder: Path = tmp_path,
        *,
        resume: dict[str, Any] | None = None,
        seed: int = 0,
        **config: Any,
    ) -> tuple[PPO, Outcome]:
        torch.manual_seed(seed)
        env, held_out = PointReach(16, seed=seed), PointReach(16, seed=99)
        algorithm = PPO(env, NetworkConfig(hidden=[16]), PPOConfig(horizon=8, epochs=2, minibatches=2))
        settings = RunConfig(**({"total_steps": total_steps, "evaluations": 2, "checkpoint_seconds": 0.0} | config))

        def evaluate(policy: Any) -> Any:
            return run_episodes(held_out, policy, seed=5)

        outcome = train(algorithm, evaluate, folder, settings, logger=QUIET, settings={"seed": seed}, resume=resume)
        return algorithm, outcome

    return start
