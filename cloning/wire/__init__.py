"""Wire: the simulator's end of the socket between server and simulator."""
