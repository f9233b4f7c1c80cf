"""Objects that live in one process: pickling and deep copies are refused at once, with the way out."""

from __future__ import annotations

from typing import Any, NoReturn, Self


class Unpicklable:
    """Base of what holds compiled kernels, arrays on a device or recorded graphs, which other processes cannot use.

    ``copy.copy`` still makes another reference to the same arrays.

    Args:
        instead: Of a subclass, as the keyword ``instead`` of its class statement: what to send or copy in its place.
    """

    _instead = ""

    def __init_subclass__(cls, instead: str = "", **options: Any) -> None:
        super().__init_subclass__(**options)
        if instead:
            cls._instead = instead

    def way_out(self) -> str:
        """What to do instead, for messages."""
        return self._instead

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise TypeError(
            f"{type(self).__name__}: cannot be pickled, deep-copied or sent to another process, as it holds compiled "
            f"kernels and memory of this one; {self.way_out()}"
        )

    def __copy__(self) -> Self:
        other = type(self).__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other
