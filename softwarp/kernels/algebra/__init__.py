"""Arithmetic of all kernels: scalars and lanes, vectors, rotations, registers, random numbers."""
