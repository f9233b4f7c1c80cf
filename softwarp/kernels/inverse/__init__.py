"""Inverse control: effectors, actuators, the quadratic program, laws beside it."""
