"""A kinematic unicycle simulator."""
