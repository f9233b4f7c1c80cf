"""Frames, which are rigid bodies and rod nodes: motion, inertia, momentum, prescribed unknowns."""
