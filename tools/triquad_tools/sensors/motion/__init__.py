"""The motion of frames in each other, and clouds corrected by it."""
