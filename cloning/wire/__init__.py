"""Wire: both ends of the socket between server and simulator."""
