"""How calls travel: a Zenoh connection, and the drivers that run calls."""
