"""Colours of things in pictures and USD, sRGB in [0, 1]."""

BODY = (0.35, 0.62, 0.68)
CLAMP = (0.30, 0.33, 0.38)  # vertices held fixed
CABLE = (0.98, 0.58, 0.12)
CABLE_SLACK, CABLE_TAUT = (0.86, 0.87, 0.90), (0.98, 0.50, 0.08)
CABLE_TAUT_ON_STRESS = (0.05, 0.80, 0.95)  # a hue that the stress scale lacks
GOAL = (0.16, 0.72, 0.36)
BACKGROUND = (0.94, 0.95, 0.965)
FLOOR_EVEN, FLOOR_ODD = (0.86, 0.87, 0.89), (0.78, 0.80, 0.83)
