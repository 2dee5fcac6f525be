"""What a server does that shares a map with others: docs/scale.md says what is promised."""
