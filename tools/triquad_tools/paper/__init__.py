"""The experiments of the 3QFP paper, as a command."""
