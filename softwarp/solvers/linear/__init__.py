"""Linear systems of all worlds: factors, substitutions, sides."""
