"""The server as a process: its log, who started it and asks it to stop, memory, threads, files."""
