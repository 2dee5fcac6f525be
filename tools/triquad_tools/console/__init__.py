"""The common parts of all commands: arguments, progress, tables, errors."""
