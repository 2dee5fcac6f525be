"""What every command shares: arguments, progress, tables, errors."""
