"""Pictures of the scenes: the gallery."""
