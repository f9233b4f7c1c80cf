"""Planners that search in exact copies of an environment's state.

Trees for discrete actions (OPD, UCT, OLOP, KL-OLOP) and sampled sequences for continuous ones (CEM, MPPI); each asks a
``PlanningModel`` for many steps at once. How to use them, theory and figures: docs/planning.md.
"""
