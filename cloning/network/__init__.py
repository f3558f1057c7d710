"""Network: the network that steers, its file, what it looks at, and what it is computed with."""
