"""What every part of a page works with: the scene, texts and legends, and threads that refresh."""
