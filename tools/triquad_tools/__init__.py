"""Command-line tools, the exact world and the scores."""
