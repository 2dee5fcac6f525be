"""The server as a process: its log, and the service manager that started it."""
