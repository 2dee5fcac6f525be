"""Pictures of a scene, with their legends."""
