"""The option ``fidelity`` of robots that have an accurate variant."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from softwarp.envs.options import check_choice

FIDELITIES = ("fast", "accurate")


@dataclass(kw_only=True)
class FidelityConfig:
    """Chooses mesh, element and rotation together; docs/accuracy.md shows what each costs and how far off it is.

    Attributes:
        ACCURATE: What "accurate" means, by option.
    """

    fidelity: str = "fast"  # "fast" (SOFA's elements, too stiff) or "accurate" (near converged shapes)

    ACCURATE: ClassVar[Mapping[str, Any]] = {}

    def take_fidelity(self) -> None:
        """Set the options that "accurate" stands for.

        Raises:
            ValueError: If there is no such fidelity, the robot has no accurate variant, or an option says otherwise.
        """
        check_choice(self, "fidelity", FIDELITIES)
        if self.fidelity == "fast":
            return
        label = type(self).__name__
        if not self.ACCURATE:
            raise ValueError(f"{label}: there is no accurate variant; leave fidelity out, and choose mesh and element")
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        for name, value in self.ACCURATE.items():
            given = getattr(self, name)
            if given not in (value, defaults[name]):
                raise ValueError(
                    f"{label}: fidelity='accurate' means {name}={value!r}, got {name}={given!r}; leave one of the two "
                    "out"
                )
            setattr(self, name, value)
