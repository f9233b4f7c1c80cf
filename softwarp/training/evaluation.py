"""Evaluation: whole episodes of a fixed policy on goals that training does not see."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softwarp import notices
from softwarp.model.codes import Status

_RESETS = 2  # of a world whose episode lasts as long as the batch: at its start and at its end
MEDIAN = 0.5  # of an even number the mean of the middle two, which torch.median does not take
WALL_FORCE = "wall_force"  # what environments with vessels tell beside the observation [N]; last: of the episode so far
QUANTILES = {"p25": 0.25, "p75": 0.75, "p90": 0.90}


@dataclass(frozen=True)
class Episodes:
    """Outcome of episodes, one entry each; shape (episode,)."""

    returns: Tensor  # sum of rewards
    lengths: Tensor  # environment steps
    success: Tensor  # bool, at the last step
    distance: Tensor  # m, at the last step; NaN where the environment measures none
    failed: Tensor  # bool, ended because the simulation of that world failed
    lost: Tensor  # bool, terminated otherwise without success: dropped, fallen, left where it should be
    force: Tensor  # N, largest on the wall in the episode; NaN where the environment tells none

    @property
    def count(self) -> int:
        """Number of episodes."""
        return self.returns.numel()

    def summary(self) -> dict[str, float]:
        """Means, rates and, where the environment tells them, median and quantiles of distances [m] and forces [N]."""
        result = {
            "episodes": float(self.count),
            "return": float(self.returns.mean()),
            "return_std": float(self.returns.std(unbiased=False)),
            "length": float(self.lengths.float().mean()),
            "success": float(self.success.float().mean()),
            "failed": float(self.failed.float().mean()),
            "lost": float(self.lost.float().mean()),
        }
        if not self.distance.isnan().any():
            result["distance"] = float(self.distance.quantile(MEDIAN))
            result["distance_mean"] = float(self.distance.mean())
            result |= {f"distance_{name}": float(self.distance.quantile(q)) for name, q in QUANTILES.items()}
        if not self.force.isnan().any():
            result |= {"force": float(self.force.quantile(MEDIAN)), "force_max": float(self.force.max())}
        return result


def score(summary: dict[str, float]) -> float:
    """One number by which policies are ranked, larger is better: success, then a small final distance, else return."""
    if "distance" not in summary:
        return summary["return"]
    return summary["success"] - 1e-3 * min(summary["distance"], 1.0)


@torch.no_grad()
def run_episodes(
    env: Any,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    seed: int,
    episodes: int | None = None,
    deterministic: bool = True,
    on_step: Callable[[TensorDictBase], None] | None = None,
) -> Episodes:
    """Run whole episodes, as many at once as the environment has worlds.

    Args:
        env: TorchRL environment of batch size (world,).
        policy: Reads ``observation``, writes ``action``.
        seed: Seeds the environment, so that every policy meets the same starts and goals, however long it lasts.
        episodes: How many; the number of worlds if None.
        deterministic: Whether a trained policy takes its most likely action instead of drawing one.
        on_step: Called with the TensorDict after each reset and each step of the first batch of episodes.

    Returns:
        The first ``episodes`` outcomes, in the order of the worlds.
    """
    (worlds,) = env.batch_size
    wanted = worlds if episodes is None else episodes
    kind = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    devices = [env.device] if env.device and env.device.type == "cuda" else []
    with torch.random.fork_rng(devices=devices), set_exploration_type(kind):
        if not deterministic:
            torch.manual_seed(seed)
        batches = []
        for batch in range(-(-wanted // worlds)):
            env.set_seed(seed)
            for _ in range(_RESETS * batch):  # not those that happened: early ends must not choose what comes next
                env.reset()
            batches.append(_run_batch(env, policy, on_step if batch == 0 else None, batch * worlds, wanted))
        notices.progress_ends()
    columns = {field.name: torch.cat([getattr(batch, field.name) for batch in batches]) for field in fields(Episodes)}
    return Episodes(**{name: column[:wanted] for name, column in columns.items()})


def _run_batch(
    env: Any,
    policy: Callable[[TensorDictBase], TensorDictBase],
    on_step: Callable[[TensorDictBase], None] | None,
    begun: int,
    wanted: int,
) -> Episodes:
    """One episode in each world; a world that ends early is reset and its later steps are not counted.

    ``begun`` episodes of the ``wanted`` ones are over already, which is for the progress that is told.
    """
    (worlds,) = env.batch_size
    now = env.reset()
    if on_step:
        on_step(now)
    active = torch.ones(worlds, dtype=torch.bool, device=now.device)
    returns = torch.zeros(worlds, device=now.device)
    lengths = torch.zeros(worlds, dtype=torch.int64, device=now.device)
    success, failed, lost = (torch.zeros_like(active) for _ in range(3))
    distance, force = (torch.full((worlds,), torch.nan, device=now.device) for _ in range(2))
    while active.any():
        stepped = env.step(policy(now))
        after = stepped["next"]
        returns += after["reward"].squeeze(-1) * active
        lengths += active
        for key, column in (("distance", distance), ("success", success)):
            if key in after:
                column[active] = after[key].reshape(worlds).to(column.dtype)[active]
        if WALL_FORCE in after:
            force[active] = after[WALL_FORCE][active, -1].to(force.dtype)
        done = after["done"].reshape(worlds)
        if "world_status" in after:
            failed |= active & done & (after["world_status"].reshape(worlds) >= Status.NONFINITE)
        lost |= active & after["terminated"].reshape(worlds) & ~success & ~failed
        active &= ~done
        over = min(begun + int((~active).sum()), wanted)
        notices.progress("running episodes", f"{over} of {wanted} are over, step {int(lengths.max())}")
        if on_step:
            on_step(after)
        now = env.maybe_reset(step_mdp(stepped))
        if "memory" in now:  # of a recurrent policy: forgotten where an episode begins
            now["memory"] = now["memory"] * ~done.unsqueeze(-1)
    return Episodes(*(told.cpu() for told in (returns, lengths, success, distance, failed, lost, force)))
