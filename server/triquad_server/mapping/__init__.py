"""The thread that owns the live map: regions, training labels, replay."""
