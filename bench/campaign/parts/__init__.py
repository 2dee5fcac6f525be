"""The parts of a campaign against a server, one a file."""
