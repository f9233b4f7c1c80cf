"""Colours of things in pictures and USD, sRGB in [0, 1], and how large is drawn what has no size."""

BODY = (0.35, 0.62, 0.68)
CLAMP = (0.30, 0.33, 0.38)  # vertices held fixed
CABLE = (0.98, 0.58, 0.12)
CABLE_SLACK, CABLE_TAUT = (0.86, 0.87, 0.90), (0.98, 0.50, 0.08)
CABLE_TAUT_ON_STRESS = (0.05, 0.80, 0.95)  # a hue that the stress scale lacks
MEMBRANE = (0.13, 0.33, 0.45)
ROD, ROD_STRIPE = (0.33, 0.40, 0.58), (0.98, 0.84, 0.55)
ROD_THIN = (0.93, 0.40, 0.08)  # far too thin for its picture, where it is drawn wider
KINEMATIC = (0.62, 0.64, 0.68)  # rigid bodies whose motion is prescribed
RIGID = (  # free rigid bodies, in turn
    (0.90, 0.73, 0.46),
    (0.83, 0.45, 0.38),
    (0.42, 0.57, 0.79),
    (0.56, 0.69, 0.45),
    (0.66, 0.50, 0.70),
    (0.93, 0.60, 0.36),
)
CONTACT, FORCE = (0.98, 0.93, 0.80), (0.86, 0.12, 0.22)
JOINT = (0.16, 0.18, 0.24)
INVERTED = (0.88, 0.05, 0.78)  # elements inside out; a hue that nothing else has

# Parts of the scene's size.
ARROW_LENGTH = 0.3  # of a strong contact force
ARROW_EXCESS = 1.5  # times that: longest arrow
ARROW_RADIUS = 0.008
POINT_RADIUS = 0.010  # of a contact
AXIS_LENGTH = 0.28  # of a joint
MARK_RADIUS = 0.009  # of an element inside out

GOAL = (0.16, 0.72, 0.36)
BACKGROUND = (0.94, 0.95, 0.965)
FLOOR_EVEN, FLOOR_ODD = (0.86, 0.87, 0.89), (0.78, 0.80, 0.83)


def rigid_color(number: int, is_kinematic: bool) -> tuple[float, float, float]:
    """Colour of a rigid body by its number."""
    return KINEMATIC if is_kinematic else RIGID[number % len(RIGID)]
