"""Experiments on the map, run by hand; training of the MLP that regions begin with."""
