"""The way of calls to a server: a Zenoh connection, and the drivers that run calls."""
