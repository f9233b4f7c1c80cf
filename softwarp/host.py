"""Memory that this machine can give, within the limits that its processes are given."""

from __future__ import annotations

from pathlib import Path

BOUNDLESS = 1 << 62  # free bytes where the system does not tell, and limits that are none


def free_memory() -> int:
    """Bytes that this process can still take; ``BOUNDLESS`` where the system does not tell."""
    return min(_available(), _left_in_groups())


def _available() -> int:
    """Memory that the machine can give without swapping, where it says so."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return BOUNDLESS
    found = [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    return found[0] if found else BOUNDLESS


def _left_in_groups() -> int:
    """What the control groups of this process leave, as in a container."""
    try:
        entries = [line.split(":", 2) for line in Path("/proc/self/cgroup").read_text().splitlines()]
    except OSError:
        return BOUNDLESS
    left = BOUNDLESS
    for _, controllers, path in entries:
        if controllers == "":
            root, limit, usage = Path("/sys/fs/cgroup"), "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            root, limit, usage = Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes"
        else:
            continue
        here = root / path.lstrip("/")
        for folder in (here, *here.parents):
            if folder == root or root in folder.parents:
                left = min(left, _left_in(folder, limit, usage))
    return left


def _left_in(folder: Path, limit: str, usage: str) -> int:
    """Limit less use of one control group; pages of files that it can drop count as free."""
    try:
        most, used = (folder / limit).read_text().strip(), int((folder / usage).read_text())
        if most == "max":
            return BOUNDLESS
        statistics = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
    except (OSError, ValueError):
        return BOUNDLESS
    return max(int(most) - used + int(statistics.get("inactive_file", 0)), 0)
