"""What a campaign does to a server, one part a file."""
