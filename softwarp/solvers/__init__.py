"""Algorithms without physics: orders of launches, linear systems, Newton control."""
