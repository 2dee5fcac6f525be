"""Messages as they travel, and the keys that they travel on."""
