"""Requests: whose turn it is, who works at them, and what became of them."""
