"""The command lines of the commands, which import nothing slow; their work is in ``work``."""
