"""Multiplier rows (cables, air chambers, joints, contacts) and the solvers of their laws."""
