"""Wire: the server's and the simulator's end of the socket between them."""
