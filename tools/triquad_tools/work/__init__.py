"""The work of each command, in the function ``work`` of the module of its name."""
