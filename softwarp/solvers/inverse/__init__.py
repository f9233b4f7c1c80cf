"""The inverse problem: effectors, actuators, laws and settling."""
