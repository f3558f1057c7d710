"""The road: how the car moves, where the two tracks go, and what a camera sees from where."""
