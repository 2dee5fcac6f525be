"""What is intact of a damaged file."""
