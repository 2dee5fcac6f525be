"""The Zenoh session, and its configuration."""
