"""Road: how the car moves, the two tracks, and the camera geometry."""
