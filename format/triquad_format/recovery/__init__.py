"""The recovery of what is intact of a damaged file."""
