"""Policies written by hand, one file per robot, and the table of all."""
