"""Energies, forces and stiffness of elements, and their sums over nodes and blocks."""
