"""Arrays that a step fills anew, and launches over them."""
