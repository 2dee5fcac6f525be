"""A map answered with numpy alone: the reference for compiled code."""
