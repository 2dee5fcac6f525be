"""The parts of a map file: records to bytes and back."""
