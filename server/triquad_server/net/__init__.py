"""The Zenoh session, and requests on it."""
