"""How frames moved in each other, and clouds corrected by it."""
