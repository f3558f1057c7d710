"""Network: the network that steers, its file, what it looks at, and what it is computed with."""

FORMAT = "behavioral-cloning"  # of the model file, which contains this text; here, where it is known without PyTorch
