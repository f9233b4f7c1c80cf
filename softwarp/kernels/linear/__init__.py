"""Block factorisations of the linear system of all worlds."""
