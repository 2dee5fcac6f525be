"""The server as a process: log, service manager, stop, memory, threads, and files."""
