"""What every part of a page works with: scene, panel, colours, and threads that refresh."""
