"""Worlds that are like those of the 3QFP paper, and its experiments in them."""
