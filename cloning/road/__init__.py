"""Road: how the car moves, the centre lines of the two tracks, and the camera geometry."""
