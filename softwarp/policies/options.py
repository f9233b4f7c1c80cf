"""Settings: of networks; loading them loads no Torch."""

from __future__ import annotations

from dataclasses import dataclass, field

from softwarp.ranges import check_fields

ACTIVATION_KINDS = ("elu", "relu", "silu", "tanh")


@dataclass
class NetworkConfig:
    """Shape of the networks."""

    hidden: list[int] = field(default_factory=lambda: [128, 128])  # units of each hidden layer
    activation: str = "elu"  # elu, relu, silu or tanh
    initial_std: float = 0.4  # of PPO's continuous actions, half their range being 1
    recurrent: int = 0  # units of an LSTM between observation and networks; 0: none
    shared: bool = False  # PPO's actor and critic have the hidden layers in common

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        check_fields(self, "network")
        if self.activation not in ACTIVATION_KINDS:
            valid = ", ".join(ACTIVATION_KINDS)
            raise ValueError(f"network.activation: {self.activation!r} is unknown; choose from {valid}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"network.hidden: needs layers of at least 1 unit each, got {list(self.hidden)}")
        if not 0.02 <= self.initial_std <= 2.0:
            raise ValueError(f"network.initial_std: must lie in [0.02, 2], got {self.initial_std:g}")
        if self.recurrent < 0:
            raise ValueError(f"network.recurrent: must be a number of units, or 0 for none, got {self.recurrent}")
