"""Options of the task ``tasks/multi_gait_reduced.py``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from softwarp.envs.options import check_choice
from softwarp.envs.options.multi_gait_full import MultiGaitFullConfig

OBSERVED_KINDS = ("points", "modes")


@dataclass(kw_only=True)
class MultiGaitReducedConfig(MultiGaitFullConfig):
    """Options of the MultiGaitReduced environment: those of MultiGaitFull."""

    reduced: str | None = None  # file of softwarp reduce; None: the modes that come with softwarp, of its own options
    observed: str = "points"  # "points" of the base, as MultiGaitFull, or "modes": their amplitudes

    def __post_init__(self) -> None:
        """Refuse what the modes that come with softwarp were not made for."""
        super().__post_init__()
        check_choice(self, "observed", OBSERVED_KINDS)
        if self.reduced is not None:
            return
        if self.mesh != "coarse":
            raise ValueError(
                f"MultiGaitReducedConfig: mesh={self.mesh!r}: the modes that come with softwarp were made for "
                "mesh='coarse'; make others with softwarp reduce env=multi_gait_full FILE.npz (env.chambers=each "
                "frame=floating to turn), and name them in reduced='FILE.npz', or run MultiGaitFull"
            )

    @classmethod
    def paper(cls, **options: Any) -> MultiGaitReducedConfig:
        """SofaGym's reward in cm, on our mesh: its own modes are not published, and ours hold lumping by volume."""
        faithful: dict[str, Any] = {"reward": "paper", "settle": False, "failure_penalty": 0.0}
        return cls(**(faithful | options))
